"""Right: closures say what was registered, corrections what the leader solved, and without noise both are the truth."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.corrected import CorrectedLog, RecordedOdometry
from flocc_agent.core.effects import Deliver, PersistRecord, Register
from flocc_agent.core.events import GraphOptimised, PairRegistered
from flocc_agent.core.log_copy import LogCopy, decoded
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.pose_graph import Component, GraphSolution, LoopClosure
from flocc_agent.core.registration import ODOMETRY_CORRESPONDENCES_MIN, Registration, RegistrationFailed
from flocc_agent.geometry import angle_rad, between, pose_from_tq, symmetric
from flocc_launch.simulation.invariants import Step, core, groups
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_playback import Playback
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import CandidatePair, LogCorrection
from flocc_protocol.records import ClosureRecord, RejectionRecord

Float = NDArray[np.float64]

APPLIED_M = 0.02
APPLIED_RAD = 4e-3
"""A correction may differ from the leader's solution by what it leaves out to stay small, and by rounding."""
TRUE_M = 0.15
TRUE_RAD = 0.02
"""Noise-free registrations are right to a few millimetres and 1e-4 rad, over some hops and a dozen metres."""
SOLUTIONS_MAX = 64


@dataclass(slots=True)
class Right:
    """Registrations, records, solutions and what robots apply agree with each other."""

    _solutions: dict[tuple[Term, int], GraphSolution] = field(default_factory=dict)
    _roles: dict[tuple[str, CandidatePair], tuple[KeyframeId, KeyframeId]] = field(default_factory=dict)
    _taken_back: dict[tuple[str, CandidatePair], set[KeyframeId]] = field(default_factory=dict)
    _odometry: dict[tuple[str, int], RecordedOdometry] = field(default_factory=dict)

    def step(self, step: Step) -> Iterator[str]:
        """Records that say something else than the registration, deliveries that differ from the solution."""
        if isinstance(step.event, GraphOptimised):
            self._remember(step.event)
        for effect in step.effects:
            if isinstance(effect, Register):
                self._roles[step.station.name, effect.pair] = effect.query, effect.match
                self._taken_back[step.station.name, effect.pair] = _taken_back(step.station, effect.pair)
            elif isinstance(effect, Deliver):
                yield from self._delivered(step.station, effect.correction)
        if isinstance(step.event, PairRegistered):
            yield from self._recorded(step, step.event)

    def _remember(self, event: GraphOptimised) -> None:
        self._solutions[event.term, event.round] = event.solution
        while len(self._solutions) > SOLUTIONS_MAX:
            del self._solutions[next(iter(self._solutions))]

    def _recorded(self, step: Step, event: PairRegistered) -> Iterator[str]:
        own = (e for e in step.effects if isinstance(e, PersistRecord) and e.log == step.station.log)
        for record in (decoded(effect.data) for effect in own):
            if not isinstance(record, ClosureRecord | RejectionRecord):
                continue
            if CandidatePair.of(record.query, record.match) != event.pair:
                continue
            name = f"{step.station.name} records {record.query} {record.match}"
            if (record.query, record.match) != self._roles.get((step.station.name, event.pair)):
                yield f"{name}, which it registered the other way round"
            if _taken_back(step.station, event.pair) != self._taken_back.get((step.station.name, event.pair)):
                yield f"{name}, a latent of which was made anew meanwhile"
            yield from (f"{name}, {what}" for what in _differs(record, event.result))

    def _delivered(self, station: Station, correction: LogCorrection) -> Iterator[str]:
        if station.disk.went_back:
            return  # its own log may be another version than the leader's
        solution = self._solutions.get((correction.term, correction.round))
        component = None if solution is None else component_of(solution, correction.log)
        if component is None:
            return
        odometry = self._odometry.setdefault((station.name, station.life), RecordedOdometry(_own_copy(station)))
        name = f"{station.name} applies {correction.term}/{correction.round}"
        T_map_odom = pose_from_tq(np.array(correction.T_map_odom))
        if _apart(T_map_odom, component.T_map_odom[correction.log], APPLIED_M, APPLIED_RAD):
            yield f"{name} with another T_map_odom than was solved"
        yield from (f"{name}, {what}" for what in _other_poses(correction, odometry, component))
        knots = correction.knots
        solved, told = component.covariance_map_odom.get(correction.log), None if knots is None else knots.covariance
        if (
            solved is not None
            and knots is not None
            and (told is None or not _same_covariance(symmetric(told.numpy()), solved))
        ):
            yield f"{name} with another covariance than was solved"


def _taken_back(station: Station, pair: CandidatePair) -> set[KeyframeId]:
    """Keyframes of a pair that their robot took back, as far as a robot knows."""
    return {end for end in (pair.low, pair.high) if core(station).assembly.withdrawals.is_withdrawn(end)}


def _other_poses(correction: LogCorrection, odometry: RecordedOdometry, component: Component) -> Iterator[str]:
    solved = component.T_map_keyframe[correction.log]
    corrected = CorrectedLog(correction, odometry)
    known = min(len(solved), len(corrected))
    for index in sorted({0, known // 2, known - 1}) if known else ():
        T_map_camera = corrected.pose_of(index)
        if T_map_camera is None or _apart(T_map_camera, solved[index], APPLIED_M, APPLIED_RAD):
            yield f"which puts keyframe {index} elsewhere than was solved"


def _differs(record: ClosureRecord | RejectionRecord, result: Registration | RegistrationFailed) -> Iterator[str]:
    """What a record says that its registration does not."""
    if isinstance(result, RegistrationFailed) or not _is_good(result):
        if isinstance(record, ClosureRecord):
            yield "whose registration is not good enough"
        return
    if isinstance(record, RejectionRecord):
        yield "but refuses it"
        return
    if _apart(pose_from_tq(np.array(record.T_query_match_unscaled)), result.T_query_match_unscaled, 1e-4, 1e-4):
        yield "with another pose than was measured"
    if result.covariance is not None and (
        record.covariance is None or not _same_covariance(symmetric(record.covariance.numpy()), result.covariance)
    ):
        yield "with another covariance than was measured"


def _is_good(result: Registration) -> bool:
    """Eq. (1) against R_thr, with the limits that the campaign's robots have."""
    limits = LoopClosingParameters()
    ratio = result.correspondences / max(result.odometry_correspondences, ODOMETRY_CORRESPONDENCES_MIN)
    return result.correspondences >= limits.correspondences_min and ratio >= limits.match_ratio_threshold


def untrue(swarm: Swarm) -> Iterator[str]:
    """In a swarm without noise: closures of a leader's graph, and poses that robots apply, that are not the truth.

    Where a robot had no keyframe any more by which to notice what was on its camera, nobody can know.
    """
    for group in groups(swarm):
        if any(_unnoticed(swarm, station) for station in group):
            continue
        frames: dict[LogId, Float] = {}
        for station in group:
            if core(station).election.leading:
                yield from _untrue_closures(swarm, station)
            applied = core(station).corrections.applied
            if applied is not None:
                yield from _untrue_poses(station, applied, frames)


def unlike_the_solution(swarm: Swarm) -> Iterator[str]:
    """Robots whose last keyframe is, by what they apply, elsewhere than their leader's last solution has it."""
    for group in groups(swarm):
        for leader in (station for station in group if core(station).election.leading and station.solution):
            for station in group:
                yield from _unlike(station, leader)


def _unlike(station: Station, leader: Station) -> Iterator[str]:
    applied = core(station).corrections.applied
    assert leader.solution is not None
    component = component_of(leader.solution, station.log)
    if applied is None or component is None or not len(component.T_map_keyframe[station.log]):
        return
    solved = component.T_map_keyframe[station.log]
    T_map_camera = CorrectedLog(applied, RecordedOdometry(_own_copy(station))).pose_of(len(solved) - 1)
    if T_map_camera is not None and _apart(T_map_camera, solved[-1], APPLIED_M, APPLIED_RAD):
        yield f"{station.name} has its last keyframe elsewhere than {leader.name} solved it"


def _untrue_closures(swarm: Swarm, leader: Station) -> Iterator[str]:
    logs = core(leader).gossip.logs
    stamps_s = {log: RecordedOdometry(copy).stamps_s() for log, copy in logs.items()}

    def truth(keyframe: KeyframeId) -> Float:
        return true_poses(swarm.stations[keyframe.log.robot].playback)[stamps_s[keyframe.log][keyframe.index]]

    for closure in core(leader).assembly.graph().closures:
        if _apart(_metric(closure), between(truth(closure.query), truth(closure.match)), TRUE_M, TRUE_RAD):
            yield f"{leader.name} has a closure {closure.query} {closure.match} that is not true"


def _unnoticed(swarm: Swarm, station: Station) -> bool:
    """Whether a robot knows keyframes that show what is not the scene, and were never withdrawn."""
    overlays = (each.workers.overlay for each in swarm.stations.values())
    shown = (keyframe for overlay in overlays if overlay is not None for keyframe in overlay.shown)
    logs, withdrawals = core(station).gossip.logs, core(station).assembly.withdrawals
    known = (k for k in shown if k.log in logs and k.index < logs[k.log].keyframes)
    return any(not withdrawals.is_withdrawn(keyframe) for keyframe in known)


def _metric(closure: LoopClosure) -> Float:
    T_query_match = closure.T_query_match_unscaled.copy()
    T_query_match[:3, 3] *= closure.scale_initial or 1.0
    return T_query_match


def _untrue_poses(station: Station, applied: LogCorrection, frames: dict[LogId, Float]) -> Iterator[str]:
    """Poses of a robot in the frame that the first robot of its map fixes."""
    odometry = RecordedOdometry(_own_copy(station))
    true_at = true_poses(station.playback)
    corrected = CorrectedLog(applied, odometry)
    for index, stamp_s in enumerate(odometry.stamps_s()):
        T_map_camera, T_world_camera = corrected.pose_of(index), true_at[stamp_s]
        assert T_map_camera is not None
        T_map_world = frames.setdefault(applied.anchor, T_map_camera @ np.linalg.inv(T_world_camera))
        if _apart(T_map_camera, T_map_world @ T_world_camera, TRUE_M, TRUE_RAD):
            yield f"{station.name} has its keyframe {index} elsewhere than it was"
            return


@lru_cache(maxsize=256)
def true_poses(playback: Playback) -> dict[float, Float]:
    """True camera poses (4, 4), `T_world_camera`, by the stamp of each keyframe."""
    assert playback.truth is not None
    rows = np.searchsorted(playback.truth.stamps_s, [capture.stamp_s for capture in playback.captures])
    poses = playback.truth.T_fixed_body[rows] @ playback.T_body_camera
    return {capture.stamp_s: T for capture, T in zip(playback.captures, poses, strict=True)}


def component_of(solution: GraphSolution, log: LogId) -> Component | None:
    """The part of a solution that a log is in."""
    return next((component for component in solution.components if log in component.T_map_keyframe), None)


def _own_copy(station: Station) -> LogCopy:
    return core(station).gossip.logs[station.log]


def _apart(one: Float, other: Float, far_m: float, far_rad: float) -> bool:
    """Whether two poses differ by more; also where one is none."""
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return True
    distance_m = float(np.linalg.norm(one[:3, 3] - other[:3, 3]))
    return distance_m > far_m or angle_rad(one[:3, :3].T @ other[:3, :3]) > far_rad


def _same_covariance(told: Float, meant: Float) -> bool:
    """Whether a covariance is one, and the one that was meant."""
    return bool(
        np.isfinite(told).all()
        and np.allclose(told, meant, rtol=1e-3, atol=1e-12)
        and np.linalg.eigvalsh(told).min() > 0.0
    )
