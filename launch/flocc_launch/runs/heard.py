"""What robots say to each other, as the events that a run folder would hold: for those who watch without a folder.

An agent's own page reads them from the logs that the agent holds, a live view from what it overhears. Neither knows
where other robots' cameras sit on their bodies, so that these events speak of cameras where a run folder's speak of
bodies.
"""

from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.registration import closure_probability, match_ratio
from flocc_launch.runs.run_records import (
    ClosureAccepted,
    ClosureRejected,
    CorrectionApplied,
    Event,
    KeyframeCaptured,
    LeaderFollowed,
    LeaderLost,
)
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import Heartbeat, LogCorrection
from flocc_protocol.records import ClosureRecord, KeyframeRecord, Record, RejectionRecord

ROBOTS_MAX = 256


class Heard:
    """Turns records, corrections and heartbeats into events, each change once."""

    def __init__(self, steepness: float) -> None:
        """Begin to listen.

        Args:
            steepness: k of Eq. (2), for the probability of closures.
        """
        self._steepness = steepness
        self._followed: dict[str, tuple[int, str] | None] = {}
        self._corrected: dict[LogId, LogCorrection] = {}

    def record(self, log: LogId, record: Record, t: float) -> Event | None:
        """The event that a log's next record tells of; None where people need not know."""
        match record:
            case KeyframeRecord(index, stamp_s, T_odom_camera):
                return KeyframeCaptured(
                    t=t,
                    robot=log.robot,
                    event="keyframe",
                    keyframe=str(KeyframeId(log, index)),
                    stamp_s=stamp_s,
                    T_odom_body=list(T_odom_camera),
                )
            case ClosureRecord():
                return ClosureAccepted(
                    t=t,
                    robot=log.robot,
                    event="closure_accepted",
                    query=str(record.query),
                    match=str(record.match),
                    ratio=record.match_ratio,
                    probability=closure_probability(record.match_ratio, self._steepness),
                    correspondences=record.correspondences,
                    odometry_correspondences=record.odometry_correspondences,
                    scale_initial=record.scale_initial,
                    by=log.robot,
                )
            case RejectionRecord():
                return ClosureRejected(
                    t=t,
                    robot=log.robot,
                    event="closure_rejected",
                    query=str(record.query),
                    match=str(record.match),
                    ratio=match_ratio(record.correspondences, record.odometry_correspondences),
                    reason=record.reason,
                )
            case _:
                return None

    def correction(self, correction: LogCorrection, t: float) -> CorrectionApplied | None:
        """The event of a log's newer correction; None for one that is known or older."""
        held = self._corrected.get(correction.log)
        if held is not None and (correction.term, correction.round) <= (held.term, held.round):
            return None
        if held is None and len(self._corrected) >= ROBOTS_MAX:
            return None
        self._corrected[correction.log] = correction
        return CorrectionApplied(
            t=t,
            robot=correction.log.robot,
            event="correction",
            term=str(correction.term),
            round=correction.round,
            map_frame=map_frame(correction.anchor),
            T_map_odom=list(correction.T_map_odom),
            frame_changed=held is None or held.anchor != correction.anchor,
        )

    def heartbeat(self, sender: LogId, heartbeat: Heartbeat, t: float) -> Event | None:
        """The event of another leader than the sender followed before; None where nothing changed."""
        advert = heartbeat.leader
        followed = None if advert is None else (advert.term.counter, advert.term.leader.robot)
        known = self._followed.get(sender.robot)
        if followed == known or (sender.robot not in self._followed and len(self._followed) >= ROBOTS_MAX):
            return None
        self._followed[sender.robot] = followed
        if followed is None:
            return LeaderLost(t=t, robot=sender.robot, event="leader_lost")
        return LeaderFollowed(t=t, robot=sender.robot, event="leader", term=followed[0], leader=followed[1])
