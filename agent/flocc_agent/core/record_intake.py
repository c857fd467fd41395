"""What is derived from the logs knows of each new record: the pose graph, loop closing, place recognition.

A log that is given up for another one is forgotten by all of them.
"""

from collections.abc import Iterable

from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.effects import Effect, Report
from flocc_agent.core.giving_up import LOOK_PERIOD_S, expendable
from flocc_agent.core.gossip import Gossip, NewRecord
from flocc_agent.core.log_copy import BLOCK_RECORDS
from flocc_agent.core.loop_closing import LoopClosing
from flocc_agent.core.place_recognition import Candidate, PlaceRecognition
from flocc_agent.core.reports import ClosureWithdrawn, FrontEndsDiffer
from flocc_agent.core.restored import Restored
from flocc_protocol.arrays import Array
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import ClosureRecord, KeyframeRecord, LatentRecord, RejectionRecord, WithdrawalRecord


class RecordIntake:
    """Tells of new records whatever is made out of them."""

    def __init__(
        self,
        own: LogId,
        gossip: Gossip,
        assembly: GraphAssembly,
        recognition: PlaceRecognition,
        closing: LoopClosing,
        restored: Restored,
    ) -> None:
        self._own = own
        self._gossip = gossip
        self._assembly = assembly
        self._recognition = recognition
        self._closing = closing
        self._closed = restored.closed()
        self._of_map = frozenset() if restored.saved is None else restored.saved.closed
        self._served = frozenset(() if restored.saved is None else restored.latents)
        self._partnered: set[tuple[KeyframeId, LogId]] = set()
        self._looked_for_room_s = float("-inf")

    def take(self, new_records: Iterable[NewRecord], now: float) -> list[Effect]:
        """Let everything that is derived from the logs know of new records; places are recognised at the end."""
        described: list[tuple[KeyframeId, Array]] = []
        effects: list[Effect] = []
        filled: list[tuple[LogId, int]] = []
        uncounted: list[CandidatePair] = []
        judged: dict[tuple[LogId, LogId], CandidatePair] = {}
        for new in new_records:
            uncounted += self._assembly.add(new)
            if (new.number + 1) % BLOCK_RECORDS == 0:
                filled.append((new.log, new.number))
            match new.record:
                case KeyframeRecord(index, _, _, descriptor):
                    self._closing.on_keyframe(new.log)
                    keyframe = KeyframeId(new.log, index)
                    if descriptor is not None and self._may_match(keyframe):
                        described.append((keyframe, descriptor))
                case WithdrawalRecord(log, first, end) if log == new.log:
                    self._closing.on_withdrawal(log, first, end)
                case LatentRecord(index):
                    self._closing.latents.names.add(KeyframeId(new.log, index), new.number)
                case ClosureRecord(query, match):
                    pair = CandidatePair.of(query, match)
                    judged[pair.low.log, pair.high.log] = pair
                    self._closing.on_closure(pair, now)
                case RejectionRecord(query, match, reason, _, odometry_correspondences):
                    pair = CandidatePair.of(query, match)
                    judged[pair.low.log, pair.high.log] = pair
                    was_seen = odometry_correspondences > 0
                    if self._closing.on_rejection(pair, reason, was_seen):
                        effects += self._front_ends_differ(query.log, match.log)
                case _:
                    pass  # what was measured, and what a later version says, concerns the graph only
        for pair in uncounted:
            effects += self._uncounted(pair, now)
        effects += self._recognise(described, now) if described else []
        for pair in judged.values():
            effects += self._ask(pair, now)
        for log, number in filled:
            self._lend_rows(log, number // BLOCK_RECORDS)
        return effects

    def _ask(self, judged: CandidatePair, now: float) -> list[Effect]:
        """Have pairs registered that would tell whether an own way and another one are joined rightly."""
        if self._own not in (judged.low.log, judged.high.log):
            return []
        asked = [pair for pair in self._assembly.asked(judged) if all(map(self._may_match, (pair.low, pair.high)))]
        likeness = ((pair, self._recognition.similarity(pair)) for pair in asked)
        found = [Candidate(pair, similarity) for pair, similarity in likeness if similarity is not None]
        return self._closing.on_asked(found, now) if found else []

    def _uncounted(self, pair: CandidatePair, now: float) -> list[Effect]:
        """A closure does not count: its pair is registered once more, where latents were made anew."""
        withdrawals = self._assembly.withdrawals
        again = withdrawals.asks_again(pair)
        if again:
            self._closing.on_withdrawn(pair, now)
        own = (end for end in (pair.low, pair.high) if end.log == self._own)
        is_own = any(withdrawals.is_withdrawn(end) for end in own)
        return [Report(ClosureWithdrawn(query=pair.low, match=pair.high, again=again))] if is_own else []

    def given_up_for(self, wanting: LogId, now: float) -> LogId | None:
        """Forget a log that nothing refers to, for one that has no room; None where there is none, or just was."""
        if now < self._looked_for_room_s + LOOK_PERIOD_S:
            return None
        self._looked_for_room_s = now
        kept = self._assembly.tied() | self._closed | {self._own}
        log = expendable(
            self._gossip.logs,
            wanting,
            lambda each: each not in kept and not self._closing.is_written(each),
            lambda each: self._gossip.silent_s(each, now),
        )
        if log is not None:
            self._gossip.forget(log)
            self._assembly.forget(log)
            self._recognition.forget(log)
            self._closing.forget(log)
        return log

    def restore(self, logs: Iterable[tuple[LogId, Iterable[bytes]]], now: float) -> None:
        """Know again the encoded records of logs, in order.

        Resolved pairs come first, so that no pair of the past is found again, nor another one in its place.
        """
        news = [new for log, records in logs for new in self._restore_log(log, records)]
        self.take([new for new in news if not isinstance(new.record, KeyframeRecord)], now)
        for new in news:
            if isinstance(new.record, ClosureRecord | RejectionRecord):
                query, match = new.record.query, new.record.match
                self._partnered |= {(query, match.log), (match, query.log)}
        self.take([new for new in news if isinstance(new.record, KeyframeRecord)], now)
        self._partnered.clear()
        for log, copy in self._gossip.logs.items():
            for block in range(len(copy) // BLOCK_RECORDS):
                self._lend_rows(log, block)

    def _restore_log(self, log: LogId, records: Iterable[bytes]) -> Iterable[NewRecord]:
        """A log as it is on the disk, up to a record that nobody would take any more; others have the rest."""
        try:
            for data in records:
                yield self._gossip.restore(log, data)
        except DecodeError:
            if log == self._own:
                raise  # whoever reads the disk checks the own log before: its numbers must not be used twice

    def _lend_rows(self, log: LogId, block: int) -> None:
        """Descriptors of a full block are held once, by the log."""
        self._recognition.lend(log, *self._gossip.logs[log].descriptors(block))

    def _may_match(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe can be registered; of a pruned map not all have a latent."""
        return keyframe.log not in self._of_map or keyframe in self._served

    def _recognise(self, keyframes: list[tuple[KeyframeId, Array]], now: float) -> list[Effect]:
        """Look for keyframes' candidates; after a restart not where both already had a partner in the other's log."""
        found = self._recognition.on_keyframes(keyframes)
        if self._partnered:
            found = [(k, c) for k, c in found if not self._had_partners(k, c.pair.other(k))]
        return self._closing.on_candidates([candidate for _, candidate in found], now) if found else []

    def _had_partners(self, one: KeyframeId, other: KeyframeId) -> bool:
        """Whether each of two keyframes was registered with one of the other's log; else their pair waits still."""
        return (one, other.log) in self._partnered and (other, one.log) in self._partnered

    def _front_ends_differ(self, first: LogId, second: LogId) -> list[Effect]:
        """Tell, where it concerns this robot."""
        others = [log.robot for log in (first, second) if log != self._own]
        return [Report(FrontEndsDiffer(peer=others[0]))] if len(others) == 1 else []
