"""The bully election (Garcia-Molina 1982): what robots say of leaders."""

from dataclasses import dataclass

from flocc_protocol.codec import TERM, Kinds, integer, struct
from flocc_protocol.ids import TERM_COUNTER_MAX, Term

COMPUTE_CLASS_MAX = 9
HOPS_MAX = 255
COUNTER_MAX = 2**53 - 1


@dataclass(frozen=True, slots=True)
class LeaderAdvert:
    """The leader that the sender follows, as far as the sender knows.

    Attributes:
        term: Term of that leader.
        compute_class: The leader's compute class.
        beat: The leader's own counter; a leader is alive as long as this grows.
        hops: Robots between the leader and the sender; 0 when the sender leads.
    """

    term: Term
    compute_class: int
    beat: int
    hops: int


@dataclass(frozen=True, slots=True)
class Election:
    """ELECTION of the bully algorithm (Garcia-Molina 1982), to robots that outrank the sender."""

    counter: int


@dataclass(frozen=True, slots=True)
class Answer:
    """ANSWER: a robot that outranks the asker is alive and takes over the election."""

    counter: int


@dataclass(frozen=True, slots=True)
class Coordinator:
    """COORDINATOR: the sender claims a term."""

    advert: LeaderAdvert


@dataclass(frozen=True, slots=True)
class Handover:
    """The leader leaves in order; nobody needs to wait for its silence."""

    term: Term


BEAT = integer(0, COUNTER_MAX)
TERM_COUNTER = integer(0, TERM_COUNTER_MAX)
COMPUTE_CLASS = integer(0, COMPUTE_CLASS_MAX)
ADVERT = struct(LeaderAdvert, term=TERM, compute_class=COMPUTE_CLASS, beat=BEAT, hops=integer(0, HOPS_MAX))


CODECS: Kinds = {
    "election": (Election, struct(Election, counter=TERM_COUNTER)),
    "answer": (Answer, struct(Answer, counter=TERM_COUNTER)),
    "coordinator": (Coordinator, struct(Coordinator, advert=ADVERT)),
    "handover": (Handover, struct(Handover, term=TERM)),
}
