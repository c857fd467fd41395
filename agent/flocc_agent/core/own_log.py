"""This robot's own log: what becomes a record of it, in which order, and what waits for a keyframe's record."""

from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.effects import Broadcast, Effect, Encode, Report
from flocc_agent.core.events import KeyframeCaptured, Withdrawn
from flocc_agent.core.gossip import Gossip
from flocc_agent.core.judgement import told
from flocc_agent.core.measurements import (
    WAITING_MAX,
    BadMeasurement,
    Measurement,
    belongs_to,
    measurement_refused,
    measurement_report,
    record_of,
)
from flocc_agent.core.own_keyframes import OwnKeyframes
from flocc_agent.core.record_intake import RecordIntake
from flocc_agent.core.reports import KeyframeTaken, LatentLost
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair, Records
from flocc_protocol.records import (
    ClosureRecord,
    KeyframeRecord,
    LatentRecord,
    Record,
    RejectionRecord,
    WithdrawalRecord,
)


class OwnLog:
    """Appends to the own log; what is derived from the logs knows of each record at once."""

    def __init__(
        self, log: LogId, gossip: Gossip, assembly: GraphAssembly, intake: RecordIntake, *, has_keys: bool
    ) -> None:
        self._log = log
        self._gossip = gossip
        self._assembly = assembly
        self._intake = intake
        self._has_keys = has_keys
        self._keyframes = OwnKeyframes()

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return self._keyframes.sizes()

    def keyframes_given(self) -> int:
        """Own keyframes that were captured, recorded or not: the next one's number."""
        return self._gossip.logs[self._log].keyframes + len(self._keyframes)

    def on_captured(self, event: KeyframeCaptured) -> list[Effect]:
        """Number a keyframe and let it be encoded."""
        index = self.keyframes_given()
        self._keyframes.captured(index, event.stamp_s, event.T_odom_camera)
        return [Encode(KeyframeId(self._log, index), event.image, event.T_odom_camera)]

    def on_encoded(
        self,
        keyframe: KeyframeId,
        descriptor: Array | None,
        now: float,
        sha256: bytes = b"",
        withdrawn: Withdrawn | None = None,
    ) -> list[Effect]:
        """Append the records of all keyframes that are ready, in the order of capture, and what was measured there.

        A keyframe that failed to encode has a record all the same, with its odometry: measurements need no more.
        """
        self._keyframes.encoded(keyframe.index, descriptor, sha256, withdrawn)
        effects: list[Effect] = []
        for ready in self._keyframes.ready():
            if ready.withdrawn is not None:  # first, since pairs of this keyframe take the scale from the one before
                effects += self._withdraw(ready.index, ready.withdrawn, now)
            record = KeyframeRecord(ready.index, ready.stamp_s, ready.T_odom_camera, ready.descriptor)
            effects += self.append(record, now)
            effects.append(_keyframe_report(self._log, record))
            if self._has_keys and ready.sha256:
                effects += self.append(LatentRecord(ready.index, ready.sha256), now)
            for measurement in self._keyframes.take_measured(ready.index):
                effects += self._append_measurement(measurement, KeyframeId(self._log, ready.index), now)
        return effects

    def on_measured(self, measurement: Measurement, index: int, now: float) -> list[Effect]:
        """Append what was measured at a recorded keyframe; what belongs to a later one waits for its record."""
        keyframe = belongs_to(measurement, self._log, index)
        recorded = self._gossip.logs[self._log].keyframes
        if keyframe.index < recorded:
            return self._append_measurement(measurement, keyframe, now)
        if keyframe.index >= max(self.keyframes_given(), 1):
            return [measurement_refused(measurement, keyframe, "there is no such keyframe")]
        if self._keyframes.keep(measurement, keyframe.index):
            return []
        return [measurement_refused(measurement, keyframe, f"{WAITING_MAX} others wait for this keyframe")]

    def append(self, record: Record, now: float) -> list[Effect]:
        """Append a record to the own log; before a judgement, what it knows of withdrawn keyframes."""
        said: list[Effect] = []
        if isinstance(record, ClosureRecord | RejectionRecord):
            pair = CandidatePair.of(record.query, record.match)
            for known in self._assembly.withdrawals.unsaid(self._log, pair):
                said += self.append(known, now)
        new, effects, batch = self._gossip.append(record)
        return [*said, *effects, Broadcast(Records((batch,))), *self._intake.take([new], now)]

    def judge(self, record: ClosureRecord | RejectionRecord, now: float) -> list[Effect]:
        """Append what was found of a pair, and tell of it."""
        return [*self.append(record, now), Report(told(record, self._log))]

    def reject_lost(self, pairs: list[CandidatePair], keyframe: KeyframeId, now: float) -> list[Effect]:
        """Pairs whose latent exists no more are rejected, so that nobody waits for them."""
        effects: list[Effect] = [Report(LatentLost(keyframe=keyframe))] if pairs else []
        for pair in pairs:
            effects += self.judge(RejectionRecord(pair.low, pair.high, "a latent was lost", 0, 0), now)
        return effects

    def _withdraw(self, end: int, withdrawn: Withdrawn, now: float) -> list[Effect]:
        """Take the keyframes before one back, after the log said what their latents are now, where it says so."""
        effects: list[Effect] = []
        for index, sha256 in enumerate(withdrawn.sha256, end - len(withdrawn.sha256)):
            if self._has_keys and sha256:
                effects += self.append(LatentRecord(index, sha256), now)
        first = max(end - withdrawn.count, 0)
        if first < end:
            effects += self.append(WithdrawalRecord(self._log, first, end, withdrawn.is_final), now)
        return effects

    def _append_measurement(self, measurement: Measurement, keyframe: KeyframeId, now: float) -> list[Effect]:
        try:
            record = record_of(measurement, keyframe)
        except BadMeasurement as error:
            return [measurement_refused(measurement, keyframe, str(error))]
        return [*self.append(record, now), measurement_report(measurement, keyframe)]


def _keyframe_report(log: LogId, record: KeyframeRecord) -> Report:
    keyframe = KeyframeId(log, record.index)
    return Report(KeyframeTaken(keyframe=keyframe, stamp_s=record.stamp_s, T_odom_body=record.T_odom_camera))
