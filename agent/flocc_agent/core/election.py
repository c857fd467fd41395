"""Bully election (Garcia-Molina 1982) among robots in range, extended over chains of robots, with terms.

Rules:
- Rank is compute class first, then lowest log. The best-ranked robot of a connected group leads it.
- A leader's own counter (`beat`) grows with each of its heartbeats. Followers pass the highest one on, with the
  hops it travelled; a leader whose beat stands still is lost, however often its name is repeated.
- A term is (counter, leader). Whoever claims one takes a counter above all that it knows to be used, and a leader
  that learns of one not below its own claims anew, so that what it says is never older than what followers applied.
- A counter is used when its leader says so itself, or a correction of it is here. What others say of counters proves
  nothing. Each proof raises the known counter by at most `COUNTER_JUMP_MAX`, so that no lie puts it out of reach for
  the others; a robot that knows of none yet takes the first one as it is, up to `FIRST_COUNTER_MAX`. All proofs
  together raise it by at most `RISE_PER_S`, once `RISE_MAX` is used up.

`TRANSITIONS` is the whole machine: what may happen in which role, and which role follows. `LeaderElection.tick` says
what a role does when its time is up.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from flocc_agent.core.effects import Broadcast, Effect, PersistTerm, Report, Unicast
from flocc_agent.core.parameters import ElectionParameters
from flocc_agent.core.reports import LeaderFollowed, LeaderLost, PeerRefused
from flocc_protocol.ids import TERM_COUNTER_MAX, LogId, Term
from flocc_protocol.messages import (
    COUNTER_MAX,
    Answer,
    Coordinator,
    Election,
    Handover,
    Heartbeat,
    LeaderAdvert,
)

Rank = tuple[int, LogId]

ANSWER_TIMEOUT_S = 0.6
"""Without an ANSWER for this long the robot claims a term: more than a round trip with a lost message."""
COORDINATOR_TIMEOUT_S = 2.0
"""After an ANSWER the robot waits this long for a leader, then asks again: three times as long as that one asks."""
COUNTER_JUMP_MAX = 1000
"""One proof raises the known counter by at most this; a robot that was away for longer needs several."""
FIRST_COUNTER_MAX = 2**16
"""What a robot that knows of no term yet believes at once; the rest of a greater one comes as for everybody."""
RISE_MAX, RISE_PER_S = FIRST_COUNTER_MAX + COUNTER_JUMP_MAX, 200.0
"""By how much all proofs together raise it at once, and over time, beyond one step each: so a flood of claims, each of
them signed, leaves counters that a robot which was away learns in as long as the flood lasted."""
FORGOTTEN_S = 3600.0
"""So long after the last claim only counters count that were followed, claimed here, or corrected by."""
LOST_MAX = 64
PEERS_MAX = 512


class Role(Enum):
    """What a robot is doing about leadership."""

    LISTENING = "listening"
    ELECTING = "electing"
    WAITING = "waiting"
    FOLLOWING = "following"
    LEADING = "leading"


class Turn(Enum):
    """What moves a robot from one role to another."""

    ASKS = "asks those who outrank it"
    IS_ANSWERED = "one who outranks it is alive"
    CLAIMS = "claims a term: nobody who outranks it is there, answered, or leads on time"
    HEARS = "hears of a leader that it prefers"
    LEAVES = "hands over"


TRANSITIONS: Mapping[Role, Mapping[Turn, Role]] = {
    Role.LISTENING: {
        Turn.ASKS: Role.ELECTING,
        Turn.CLAIMS: Role.LEADING,
        Turn.HEARS: Role.FOLLOWING,
    },
    Role.ELECTING: {
        Turn.IS_ANSWERED: Role.WAITING,
        Turn.CLAIMS: Role.LEADING,
        Turn.HEARS: Role.FOLLOWING,
    },
    Role.WAITING: {
        Turn.ASKS: Role.ELECTING,
        Turn.CLAIMS: Role.LEADING,
        Turn.HEARS: Role.FOLLOWING,
    },
    Role.FOLLOWING: {
        Turn.ASKS: Role.ELECTING,
        Turn.CLAIMS: Role.LEADING,
        Turn.HEARS: Role.FOLLOWING,
    },
    Role.LEADING: {
        Turn.CLAIMS: Role.LEADING,
        Turn.HEARS: Role.FOLLOWING,
        Turn.LEAVES: Role.LISTENING,
    },
}
"""Role -> what may happen in it -> the role that follows; anything else is a bug."""


def rank(compute_class: int, log: LogId) -> Rank:
    """Order in which robots lead: smaller is better."""
    return (-compute_class, log)


@dataclass(frozen=True, slots=True)
class _Peer:
    """What the election needs to know of a robot in range."""

    rank: Rank
    name: str


class LeaderElection:
    """One robot's part in the election."""

    def __init__(
        self,
        own: LogId,
        compute_class: int,
        counter_max: int,
        parameters: ElectionParameters,
        now: float,
        compute_classes: Mapping[str, int] | None = None,
    ) -> None:
        """Begin to listen.

        Args:
            own: This robot's log.
            compute_class: Its class.
            counter_max: Highest term counter that it knew before its start.
            parameters: Times and limits.
            now: Time.
            compute_classes: Of the swarm's list of members; robots that it does not name have 0, whatever they claim.
        """
        self._listed = compute_classes
        self._own = own
        self._compute_class = compute_class
        self._rank = rank(compute_class, own)
        self._parameters = parameters
        self._counter_max = counter_max
        self._followed_max = counter_max
        self._claimed_s = now
        self._rise = float(RISE_MAX)
        self._rise_s = now
        self._peers: dict[str, _Peer] = {}
        self._lost: dict[Term, int] = {}
        self._leader: LeaderAdvert | None = None
        self._role = Role.LISTENING
        self._due_s = now + parameters.startup_s

    @property
    def role(self) -> Role:
        """What this robot is doing about leadership."""
        return self._role

    @property
    def leading(self) -> bool:
        """Whether this robot leads."""
        return self._role is Role.LEADING

    @property
    def term(self) -> Term | None:
        """The term this robot follows or leads, None while there is none."""
        return self._leader.term if self._leader else None

    @property
    def counter_max(self) -> int:
        """Highest term counter that is known to be used."""
        return self._counter_max

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {"lost_terms": (len(self._lost), LOST_MAX), "peers": (len(self._peers), PEERS_MAX)}

    def advert(self) -> LeaderAdvert | None:
        """What a heartbeat says of the leader; a leader's beat grows with each call."""
        if self._leader is not None and self.leading:
            leader = self._leader
            self._leader = LeaderAdvert(leader.term, leader.compute_class, leader.beat + 1, leader.hops)
        return self._leader

    def on_heartbeat(self, sender: LogId, heartbeat: Heartbeat, now: float) -> list[Effect]:
        """Learn of a robot in range and of the leader it follows."""
        self._forget_claims(now)
        self._meet(sender, heartbeat.compute_class)
        advert = heartbeat.leader
        if advert is None:
            return self._renew_if_overtaken(now)
        refused = self._learn_counter(sender, advert.term.counter, now) if _is_first_hand(sender, advert) else []
        return [*refused, *self._on_advert(advert, now), *self._renew_if_overtaken(now)]

    def class_of(self, robot: str, claimed: int) -> int:
        """A robot's compute class, which the list of members knows better than the robot."""
        return claimed if self._listed is None else self._listed.get(robot, 0)

    def _meet(self, sender: LogId, claimed: int) -> None:
        compute_class = self.class_of(sender.robot, claimed)
        known = self._peers.get(sender.robot)
        if known is None or known.rank != (-compute_class, sender):
            self._peers[sender.robot] = _Peer(rank(compute_class, sender), sender.robot)

    def on_election(self, sender: LogId, now: float) -> list[Effect]:
        """Answer a robot that this one outranks, and take the election over.

        A follower need not: its heartbeats tell the asker of the leader, or it will miss the leader itself.
        """
        peer = self._peers.get(sender.robot)
        if peer is None or peer.rank < self._rank:
            return []
        answer: list[Effect] = [Unicast(sender.robot, Answer(self._counter_max))]
        if self.leading:
            return [*answer, *self._announce()]
        settled = self._role in (Role.ELECTING, Role.FOLLOWING)
        return answer if settled else [*answer, *self._start(now)]

    def on_answer(self, sender: LogId, now: float) -> list[Effect]:
        """A better-ranked robot is alive: wait for its claim."""
        peer = self._peers.get(sender.robot)
        if self._role is Role.ELECTING and peer is not None and peer.rank < self._rank:
            self._turn(Turn.IS_ANSWERED, now + COORDINATOR_TIMEOUT_S)
        return []

    def on_coordinator(self, sender: LogId, message: Coordinator, now: float) -> list[Effect]:
        """Hear a claim from the claimer itself; nobody claims a term for another robot."""
        advert = message.advert
        if not _is_first_hand(sender, advert):
            return [_refused(sender, "claims a term for another robot")]
        refused = self._learn_counter(sender, advert.term.counter, now)
        return [*refused, *self._on_advert(advert, now), *self._renew_if_overtaken(now)]

    def on_handover(self, sender: LogId, message: Handover, now: float) -> list[Effect]:
        """The leader leaves in order: elect at once."""
        self.on_lost(sender.robot)
        if self._leader is None or self._leader.term != message.term or message.term.leader != sender:
            return []
        return self._lose_leader("handed over", now, beat=COUNTER_MAX)

    def on_applied(self, sender: LogId, term: Term, now: float) -> list[Effect]:
        """Somebody gave a correction of this term that its leader made; what is refused must not be applied here.

        A leader whose own term is older claims anew with its next `tick`, since nobody would apply what it says; so it
        does where somebody else spoke in its term.
        """
        refused = self._learn_counter(sender, term.counter, now)
        if not refused:
            self._followed_max = max(self._followed_max, term.counter)
        if not refused and self._leader is not None and self.leading and term >= self._leader.term:
            self._due_s = float("-inf")
        return refused

    def on_distrusted(self, name: str, now: float) -> list[Effect]:
        """A leader is not believed; who follows it elects another one."""
        if self._leader is None or self.leading or self._leader.term.leader.robot != name:
            return []
        return self._lose_leader("not believed", now)

    def on_lost(self, name: str) -> None:
        """A robot is out of range; it need not be asked."""
        self._peers.pop(name, None)

    def leave(self) -> list[Effect]:
        """Hand over before an orderly stop."""
        if self._leader is None or not self.leading:
            return []
        handover = Handover(self._leader.term)
        self._leader = None
        self._turn(Turn.LEAVES, float("inf"))
        return [Broadcast(handover)]

    def tick(self, now: float) -> list[Effect]:
        """Time passed: a leader stood still, an ANSWER or a claim did not come, listening is over."""
        if self._due_s > now:
            return []
        match self._role:
            case Role.FOLLOWING:
                return self._lose_leader("silent", now)
            case Role.ELECTING:
                return self._claim()
            case Role.LISTENING | Role.WAITING:
                return self._start(now)
            case Role.LEADING:
                return self._claim()

    def deadline(self) -> float:
        """When `tick` is due next."""
        return self._due_s

    def _turn(self, turn: Turn, due_s: float) -> None:
        """Take the role that follows, until `due_s`."""
        self._role = TRANSITIONS[self._role][turn]
        self._due_s = due_s

    def _on_advert(self, advert: LeaderAdvert, now: float) -> list[Effect]:
        if advert.term.leader == self._own or advert.hops >= self._parameters.hops_max:
            return []
        compute_class = self.class_of(advert.term.leader.robot, advert.compute_class)
        heard = LeaderAdvert(advert.term, compute_class, advert.beat, advert.hops + 1)
        if heard.beat <= self._lost.get(heard.term, -1):
            return []
        if self._leader is not None and heard.term == self._leader.term:
            return self._refresh(heard, now)
        if self._prefers(heard):
            return self._follow(heard, now)
        return []

    def _refresh(self, heard: LeaderAdvert, now: float) -> list[Effect]:
        assert self._leader is not None
        if heard.beat > self._leader.beat:
            self._leader = heard
            self._due_s = now + self._parameters.leader_timeout_s
        return []

    def _prefers(self, heard: LeaderAdvert) -> bool:
        """A better-ranked leader wins over a worse one; of one leader the later term; never one below oneself."""
        heard_rank = rank(heard.compute_class, heard.term.leader)
        if self._rank < heard_rank:
            return False
        if self._leader is None or self.leading:
            return True
        current = rank(self._leader.compute_class, self._leader.term.leader)
        if heard_rank == current:
            return heard.term.counter > self._leader.term.counter
        return heard_rank < current

    def _follow(self, heard: LeaderAdvert, now: float) -> list[Effect]:
        self._leader = heard
        self._followed_max = max(self._followed_max, min(heard.term.counter, self._counter_max))
        self._turn(Turn.HEARS, now + self._parameters.leader_timeout_s)
        return [_leader_report(heard.term)]

    def _lose_leader(self, why: str, now: float, beat: int | None = None) -> list[Effect]:
        """Forget the leader; its term counts again only if its beat grows beyond the given one."""
        assert self._leader is not None
        self._lost[self._leader.term] = self._leader.beat if beat is None else beat
        while len(self._lost) > LOST_MAX:
            del self._lost[min(self._lost)]
        report = Report(LeaderLost(term=self._leader.term, reason=why))
        self._leader = None
        return [report, *self._start(now)]

    def _start(self, now: float) -> list[Effect]:
        """Ask those who outrank this robot; claim at once where there are none.

        Meanwhile it follows nobody: who repeated a leader that it does not watch would keep a dead one alive.
        """
        self._leader = None
        better = [self._peers[name] for name in sorted(self._peers) if self._peers[name].rank < self._rank]
        if not better:
            return self._claim()
        self._turn(Turn.ASKS, now + ANSWER_TIMEOUT_S)
        return [Unicast(peer.name, Election(self._counter_max)) for peer in better]

    def _claim(self) -> list[Effect]:
        self._counter_max = min(self._counter_max + 1, TERM_COUNTER_MAX)
        self._followed_max = self._counter_max
        term = Term(self._counter_max, self._own)
        self._leader = LeaderAdvert(term, self._compute_class, beat=0, hops=0)
        self._turn(Turn.CLAIMS, float("inf"))
        return [PersistTerm(term.counter), _leader_report(term), *self._announce()]

    def _announce(self) -> list[Effect]:
        advert = self.advert()
        assert advert is not None
        return [Broadcast(Coordinator(advert))]

    def _renew_if_overtaken(self, now: float) -> list[Effect]:
        """Claim a higher term when others knew a counter not below ours; bully from above a worse leader."""
        if self._leader is None:
            return []
        if self.leading:
            return self._claim() if self._counter_max > self._leader.term.counter else []
        outranks = self._rank < rank(self._leader.compute_class, self._leader.term.leader)
        return self._start(now) if outranks and self._role is Role.FOLLOWING else []

    def _learn_counter(self, sender: LogId, counter: int, now: float) -> list[Effect]:
        """A counter is proven to be used; what is far above all that is known is refused, and still raises it a bit."""
        self._rise = min(RISE_MAX, self._rise + RISE_PER_S * max(now - self._rise_s, 0.0))
        self._rise_s = now
        jump = max(1, min(COUNTER_JUMP_MAX, int(self._rise)))
        reach = self._counter_max + jump if self._counter_max else FIRST_COUNTER_MAX
        raised = max(0, min(counter, reach) - self._counter_max)
        self._rise -= raised if self._counter_max else 0
        self._counter_max += raised
        self._claimed_s = now if raised else self._claimed_s
        return [_refused(sender, "a term counter far above all others")] if counter > reach else []

    def _forget_claims(self, now: float) -> None:
        """What was claimed, and never followed nor corrected by, is not kept out of reach of others for ever."""
        if self._claimed_s + FORGOTTEN_S <= now:
            self._counter_max = self._followed_max


def _is_first_hand(sender: LogId, advert: LeaderAdvert) -> bool:
    """Whether a leader speaks of its own term."""
    return advert.term.leader == sender and advert.hops == 0


def _leader_report(term: Term) -> Report:
    return Report(LeaderFollowed(term=term.counter, leader=term.leader.robot, leader_log=term.leader))


def _refused(sender: LogId, reason: str) -> Report:
    return Report(PeerRefused(peer=sender.robot, reason=reason))
