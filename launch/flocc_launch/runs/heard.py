"""What robots say to each other, as the facts that a run folder would hold: for those who watch without a folder.

An agent's own page reads them from the logs that the agent holds, a live view from what it overhears. Neither knows
where other robots' cameras sit on their bodies, so that these facts speak of cameras where a run folder's speak of
bodies.
"""

from typing import assert_never

import numpy as np

from flocc_agent.core.judgement import told
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.reports import CorrectionApplied, Fact, KeyframeTaken, LeaderFollowed, LeaderLost
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.reporting import Reporter
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import Heartbeat, LogCorrection
from flocc_protocol.records import (
    ClosureRecord,
    KeyframeRecord,
    LatentRecord,
    MeasurementRecord,
    Record,
    RejectionRecord,
    UnknownRecord,
    WithdrawalRecord,
)

ROBOTS_MAX = 256


class Heard:
    """Turns records, corrections and heartbeats into facts, each change once."""

    def __init__(self, steepness: float) -> None:
        """Begin to listen.

        Args:
            steepness: k of Eq. (2), for the probability of closures.
        """
        self._steepness = steepness
        self._followed: dict[str, Term | None] = {}
        self._corrected: dict[LogId, LogCorrection] = {}

    def record(self, log: LogId, record: Record, t: float) -> Reported[Fact] | None:
        """What a log's next record tells of; None where people need not know."""
        if isinstance(record, MeasurementRecord | LatentRecord | WithdrawalRecord | UnknownRecord):
            return None
        match record:
            case KeyframeRecord(index, stamp_s, T_odom_camera):
                taken = KeyframeTaken(keyframe=KeyframeId(log, index), stamp_s=stamp_s, T_odom_body=T_odom_camera)
                return self._reported(log.robot, taken, t)
            case ClosureRecord() | RejectionRecord():
                return self._reported(log.robot, told(record, log), t)
            case _:
                assert_never(record)

    def _reported(self, robot: str, fact: Fact, t: float) -> Reported[Fact]:
        return Reporter(robot, np.eye(4), self._steepness).reported(fact, t)

    def correction(self, correction: LogCorrection, t: float) -> Reported[CorrectionApplied] | None:
        """What a log's newer correction tells of; None for one that is known or older."""
        held = self._corrected.get(correction.log)
        if held is not None and (correction.term, correction.round) <= (held.term, held.round):
            return None
        if held is None and len(self._corrected) >= ROBOTS_MAX:
            return None
        self._corrected[correction.log] = correction
        fact = CorrectionApplied(
            term=correction.term.counter,
            leader=correction.term.leader.robot,
            round=correction.round,
            map_frame=map_frame(correction.anchor),
            frame_changed=held is None or held.anchor != correction.anchor,
            T_map_odom=correction.T_map_odom,
        )
        return Reported(t, correction.log.robot, fact)

    def heartbeat(self, sender: LogId, heartbeat: Heartbeat, t: float) -> Reported[Fact] | None:
        """Another leader than the sender followed before; None where nothing changed."""
        advert = heartbeat.leader
        followed = None if advert is None else advert.term
        known = self._followed.get(sender.robot)
        if followed == known or (sender.robot not in self._followed and len(self._followed) >= ROBOTS_MAX):
            return None
        self._followed[sender.robot] = followed
        fact = (
            LeaderLost()
            if followed is None
            else LeaderFollowed(term=followed.counter, leader=followed.leader.robot, leader_log=followed.leader)
        )
        return Reported(t, sender.robot, fact)
