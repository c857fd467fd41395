"""Withdrawals: a robot takes keyframes back, because their latents showed what is not the scene.

A robot learns only on the way that part of its picture moves with its camera, or that the camera is mounted otherwise
than told. What was registered of the keyframes before may be wrong, and wrong alike at many pairs, which no solver can
tell from right. So its log says from which keyframe to which, and what was judged of those does not count.

Whether a judgement, a closure or a rejection, counts follows from records alone, so that all robots agree whatever the
order in which they hear of them. Latents that lost what moves with the camera are made before the record is written.
A robot that heard of a withdrawal forgets the latents it holds, and repeats the record in its own log before it judges
a pair anew; what stands after that in its log counts. A final withdrawal, where no latent can be better, nothing
follows: these keyframes carry odometry only.
"""

from typing import NamedTuple

from flocc_agent.core.pulls import remember
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import WithdrawalRecord

WITHDRAWALS_MAX = 64
"""Of one log that another one, or itself, says; a camera is doubted at most 16 times from one start to the next."""
JUDGED_ANEW_MAX = 4000
NEVER = 1 << 20
"""Rank that no judgement has."""


class _Said(NamedTuple):
    number: int
    record: WithdrawalRecord


class Withdrawals:
    """What each log says of withdrawn keyframes."""

    def __init__(self) -> None:
        self._said: dict[tuple[LogId, LogId], list[_Said]] = {}
        self._told_of: set[LogId] = set()
        """Logs of which some log says that keyframes are withdrawn: few of them, while every judgement is looked at."""
        self._judged_anew: dict[CandidatePair, int] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {"judged_anew": (len(self._judged_anew), JUDGED_ANEW_MAX)}

    def add(self, author: LogId, number: int, record: WithdrawalRecord) -> bool:
        """Take in a record of a log; whether it takes keyframes back, of which judgements counted until now."""
        said = self._said.setdefault((author, record.log), [])
        if len(said) >= WITHDRAWALS_MAX:
            return False
        said.append(_Said(number, record))
        self._told_of.add(record.log)
        return author == record.log

    def counts(self, author: LogId, number: int, pair: CandidatePair) -> bool:
        """Whether what a record of a log says of a pair counts, as far as is known."""
        if not self._tells_of(pair):
            return True
        return all(self._rank(author, number, end) >= self._needed(end) for end in (pair.low, pair.high))

    def rank(self, author: LogId, number: int, pair: CandidatePair) -> int:
        """Of how many withdrawals a judgement knew: of several, one that counts has the highest rank."""
        if not self._tells_of(pair):
            return 0
        return sum(self._rank(author, number, end) for end in (pair.low, pair.high))

    def on_judged(self, author: LogId, number: int, pair: CandidatePair) -> None:
        """A record judges a pair; it may count where an earlier judgement does not."""
        rank = self.rank(author, number, pair)
        if rank > self._judged_anew.get(pair, 0):
            remember(self._judged_anew, pair, rank, JUDGED_ANEW_MAX)

    def asks_again(self, pair: CandidatePair) -> bool:
        """Whether a pair whose closure does not count is to be registered once more."""
        return not self.is_judged_anew(pair) and self._needed_of(pair) < NEVER

    def is_judged_anew(self, pair: CandidatePair) -> bool:
        """Whether some judgement of a pair counts, though keyframes were taken back."""
        return self._judged_anew.get(pair, 0) >= self._needed_of(pair)

    def _needed_of(self, pair: CandidatePair) -> int:
        return sum(self._needed(end) for end in (pair.low, pair.high))

    def unsaid(self, author: LogId, pair: CandidatePair) -> list[WithdrawalRecord]:
        """What a log must say before it judges a pair anew: withdrawals of both ends' logs that it did not repeat."""
        logs = sorted({pair.low.log, pair.high.log} - {author})
        return [
            said.record
            for log in logs
            for said in self._said.get((log, log), ())[len(self._said.get((author, log), ())) :]
        ]

    def is_withdrawn(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe's robot took it back, once or more."""
        return self._needed(keyframe) > 0

    def is_final(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe's robot took it back for good: nothing that is judged of it counts."""
        return self._needed(keyframe) >= NEVER

    def _tells_of(self, pair: CandidatePair) -> bool:
        return pair.low.log in self._told_of or pair.high.log in self._told_of

    def _needed(self, keyframe: KeyframeId) -> int:
        """Which of its robot's withdrawals a judgement must have known."""
        said = self._said.get((keyframe.log, keyframe.log), ())
        return max((_reached(k, s.record, keyframe) for k, s in enumerate(said, 1)), default=0)

    def _rank(self, author: LogId, number: int, keyframe: KeyframeId) -> int:
        """Of which of them a record of a log knew."""
        said = self._said.get((author, keyframe.log), ())
        before = (k for k, s in enumerate(said, 1) if s.number < number and _covers(s.record, keyframe))
        return max(before, default=0)


def _covers(record: WithdrawalRecord, keyframe: KeyframeId) -> bool:
    return record.first <= keyframe.index < record.end


def _reached(k: int, record: WithdrawalRecord, keyframe: KeyframeId) -> int:
    if not _covers(record, keyframe):
        return 0
    return NEVER if record.is_final else k
