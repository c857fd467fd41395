"""What is wrong with a camera, if anything: the simplest explanation that makes pictures and odometry agree.

Explanations in order: nothing; another focal length; a camera turned on its body; a trajectory whose poses are
inverted; pictures that are mirrored; another focal length and a turn; positions and orientations of different frames.
One counts when it removes what the simpler ones leave, by more than odometry's and the pictures' own errors do, and
when turns were seen at all: a robot that only drives straight shows no focal length.

Odometry of wheels or of a phone can be so bad that nothing makes both agree. Then only what leaves far less than all
others is believed, and only axes that are others than odometry's: mirrored pictures, inverted poses, a camera turned by
60 degrees or more.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad, between, inverse
from flocc_agent.perception.watch.mount_fit import (
    Motions,
    constant_turn,
    costs,
    direction_angles_rad,
    motions_of,
    trimmed,
    turn_costs,
)
from flocc_agent.perception.watch.seen_motion import Flow, SeenMotion, seen_motion

Float = NDArray[np.float64]

PAIRS_MIN = 5
TURN_MIN_RAD = float(np.radians(1.5))
TURNS_MIN = 4
"""Pairs that turn by so much; fewer show no focal length and no mounting."""
STEP = float(np.sqrt(1.25))
"""Between focal factors that are tried."""
STEPS_FIRST = 2
STEPS_MAX = 8
"""2.4 and 0.4 are the largest and smallest factors tried."""
EVIDENCE_MIN = 4.0
DISAGREEMENT_FLOOR = 0.3
DISAGREEMENT_MAX = 4.0
"""An explanation that leaves more than this explains no focal length and no small turn: pictures or odometry are too
bad to say."""
FAR_LESS_RATIO = 0.65
"""What other axes leave of what those leave that are configured, where all leave more: right ones leave 0.23 to 0.43
of it on six drawn drives with the odometry of cars and hands."""
AGREEING_SHARE_MIN = 0.65
"""Share of the pairs that must prefer an explanation to none."""
NOISY_DISAGREEMENT = 2.0
GAIN_MIN_SIGMAS = 2.0
"""Where even the best explanation leaves more than the first, the mean gain of a pair must exceed its own uncertainty
by the second: pictures or odometry are several times as bad as assumed, and chance gains as much as a fault costs."""
FOCAL_ERROR_MIN_RATIO = 0.05
MIXED_ANGLE_MIN_RAD = float(np.radians(30.0))
"""Between directions of motion, at the median: less may be few or badly spread matches; other axes give far more."""
MOUNT_ERROR_MIN_RAD = float(np.radians(2.5))
AXES_ERROR_MIN_RAD = float(np.radians(60.0))
"""A mounting off by so much is no screw that came loose: the axes are another convention's, or upside down."""


class CameraFault(Enum):
    """What can be wrong with a camera, or with the trajectory that came with it."""

    FOCAL_LENGTH = "focal length"
    MOUNTING = "mounting"
    BOTH = "focal length and mounting"
    MIRRORED = "mirrored"
    INVERTED_POSES = "inverted poses"
    MIXED_FRAMES = "mixed frames"


AXES = frozenset({CameraFault.MOUNTING, CameraFault.MIRRORED, CameraFault.INVERTED_POSES})
"""What can be wrong with axes; a mounting by `AXES_ERROR_MIN_RAD` at least."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraVerdict:
    """What was found.

    Attributes:
        fault: What is wrong.
        focal_factor: True focal length over the configured one.
        X: (3, 3) by how much the camera is turned: true over configured mounting.
        pairs: Of keyframes that say so.
    """

    fault: CameraFault
    focal_factor: float
    X: Float
    pairs: int

    @property
    def places_wrongly(self) -> bool:
        """Whether closures of this camera put the robot where it is not: its axes are others than odometry's."""
        turned = self.fault in (CameraFault.MOUNTING, CameraFault.BOTH) and angle_rad(self.X) >= AXES_ERROR_MIN_RAD
        return turned or self.fault is CameraFault.MIRRORED


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """A fault with what it leaves.

    Attributes:
        fault: None for nothing.
        left: (N,) costs by pair; infinite where no motion was found.
    """

    fault: CameraFault | None
    left: Float
    focal_factor: float = 1.0
    X: Float | None = None


class WatchedPair:
    """A flow, and the motions that it gives by focal factor, each found once."""

    def __init__(self, flow: Flow) -> None:
        self.flow = flow
        self._seen: dict[tuple[float, bool], SeenMotion | None] = {}

    def motion(self, focal_factor: float, mirrored: bool) -> SeenMotion | None:
        """The motion under an explanation; at most two for each of the factors that are tried."""
        key = (round(focal_factor, 4), mirrored)
        if key not in self._seen:
            self._seen[key] = seen_motion(self.flow, *key)
        return self._seen[key]


class CameraTrial:
    """Pairs of one robot under the explanations that are tried."""

    def __init__(self, pairs: Sequence[WatchedPair]) -> None:
        self._pairs = tuple(pairs)

    def motions(self, focal_factor: float = 1.0, mirrored: bool = False, inverted: bool = False) -> Motions:
        """The pairs' motions under an explanation."""
        seen = [pair.motion(focal_factor, mirrored) for pair in self._pairs]
        return motions_of(seen, [_by_odometry(pair.flow, inverted) for pair in self._pairs])

    def focal_length(self, X: Float) -> _Explanation:
        """The focal factor under which pictures and odometry agree best, for a camera turned by X."""
        left = {k: self._left(k, X) for k in range(-STEPS_FIRST, STEPS_FIRST + 1)}
        best = min(left, key=lambda k: trimmed(left[k]))
        while abs(best) < STEPS_MAX and (best in (min(left), max(left))):
            beside = best + (1 if best > 0 else -1)
            left[beside] = self._left(beside, X)
            if trimmed(left[beside]) >= trimmed(left[best]):
                break
            best = beside
        factor = STEP ** (best + _vertex({k: trimmed(costs_k) for k, costs_k in left.items()}, best))
        return _Explanation(CameraFault.FOCAL_LENGTH, left[best], factor, X)

    def _left(self, k: int, X: Float) -> Float:
        return costs(self.motions(STEP**k), X)


def shows_camera(pairs: Sequence[WatchedPair]) -> bool:
    """Whether these pairs are enough, and turn enough by odometry, for a verdict."""
    turns_rad = [angle_rad(between(pair.flow.T_odom_before, pair.flow.T_odom_now)[:3, :3]) for pair in pairs]
    return len(pairs) >= PAIRS_MIN and sum(turn_rad > TURN_MIN_RAD for turn_rad in turns_rad) >= TURNS_MIN


def camera_verdict(pairs: Sequence[WatchedPair], known: CameraFault | None = None) -> CameraVerdict | None:
    """Say what is wrong with the camera that saw these pairs; None where nothing is, or nothing can be said.

    Args:
        pairs: Of consecutive keyframes.
        known: Axes that were found wrong before: they stay so where odometry is bad and they explain more than others.
    """
    if not shows_camera(pairs):
        return None
    trial = CameraTrial(pairs)
    motions = trial.motions()
    nothing = _Explanation(None, costs(motions, np.eye(3)))
    tried = [nothing, trial.focal_length(np.eye(3)), _turned(CameraFault.MOUNTING, motions)]
    found = _simplest(tried)
    if found is not nothing or trimmed(nothing.left) > DISAGREEMENT_MAX:
        tried += _farther(trial, tried[2])
        found = _simplest(tried)
    if trimmed(found.left) > DISAGREEMENT_MAX:
        return _mixed_frames(motions) or _other_axes(tried, known)
    return _named(found, nothing)


def _farther(trial: CameraTrial, mounting: _Explanation) -> list[_Explanation]:
    """What explains more than a focal length or a mounting alone."""
    assert mounting.X is not None
    mirrored = _turned(CameraFault.MIRRORED, trial.motions(mirrored=True))
    inverted = _Explanation(CameraFault.INVERTED_POSES, costs(trial.motions(inverted=True), np.eye(3)), X=np.eye(3))
    both = replace(trial.focal_length(mounting.X), fault=CameraFault.BOTH)
    motions = trial.motions(_nearest_step(both.focal_factor))
    X = constant_turn(motions)
    return [inverted, mirrored, replace(both, left=costs(motions, X), X=X)]


def _turned(fault: CameraFault, motions: Motions) -> _Explanation:
    X = constant_turn(motions)
    return _Explanation(fault, costs(motions, X), X=X)


def _nearest_step(factor: float) -> float:
    return float(STEP ** round(np.log(factor) / np.log(STEP)))


def _simplest(explanations: Sequence[_Explanation]) -> _Explanation:
    """The first that none of the others beats clearly."""
    return next(
        one for one in explanations if all(evidence(one.left, other.left) < EVIDENCE_MIN for other in explanations)
    )


def evidence(before: Float, after: Float) -> float:
    """How clearly an explanation that leaves `after` beats one that leaves `before`: about pairs times the gain."""
    left = trimmed(after)
    return len(before) * (trimmed(before) - left) / (left + DISAGREEMENT_FLOOR)


def gain_sigmas(before: Float, after: Float) -> float:
    """The mean gain of a pair over the standard error of that mean: a paired test, which scales with the noise."""
    gains = before - after
    return float(gains.mean() / max(float(gains.std(ddof=1)) / np.sqrt(len(gains)), 1e-9))


def _named(found: _Explanation, nothing: _Explanation) -> CameraVerdict | None:
    """The verdict, where it is large enough to matter and most pairs agree with it."""
    X = np.eye(3) if found.X is None else found.X
    if found.fault is None or float(np.mean(found.left < nothing.left)) < AGREEING_SHARE_MIN:
        return None
    if trimmed(found.left) > NOISY_DISAGREEMENT and gain_sigmas(nothing.left, found.left) < GAIN_MIN_SIGMAS:
        return None
    focal_is_off = abs(found.focal_factor - 1.0) >= FOCAL_ERROR_MIN_RATIO
    mount_is_off = angle_rad(X) >= MOUNT_ERROR_MIN_RAD
    fault = found.fault
    if fault is CameraFault.BOTH and not (focal_is_off and mount_is_off):
        fault = CameraFault.FOCAL_LENGTH if focal_is_off else CameraFault.MOUNTING
    matters = {CameraFault.FOCAL_LENGTH: focal_is_off, CameraFault.MOUNTING: mount_is_off}
    if not matters.get(fault, True):
        return None
    return CameraVerdict(fault, found.focal_factor, X, len(found.left))


def _other_axes(tried: Sequence[_Explanation], known: CameraFault | None) -> CameraVerdict | None:
    """Axes that leave far less than those that are configured, however much that is.

    Of axes that leave as much, those that are known, or the simplest: in a plane a mirrored camera moves as one does
    that hangs upside down.
    """
    axes = [each for each in tried if each.fault in AXES and _are_other(each)]
    axes.sort(key=lambda each: each.fault is not known)
    least = min((trimmed(each.left) for each in axes), default=0.0)
    simplest = next((each for each in axes if FAR_LESS_RATIO * trimmed(each.left) <= least), None)
    if simplest is None or simplest.fault is None or simplest.X is None:
        return None
    configured = [each.left for each in tried if each.fault is not CameraFault.BOTH and each not in axes]
    if all(_is_clear(simplest.left, other, known is not None) for other in configured):
        return CameraVerdict(simplest.fault, 1.0, simplest.X, len(simplest.left))
    return None


def _are_other(explanation: _Explanation) -> bool:
    """Whether the axes are others, not merely a little turned."""
    is_mounting = explanation.fault is CameraFault.MOUNTING
    return not is_mounting or (explanation.X is not None and angle_rad(explanation.X) >= AXES_ERROR_MIN_RAD)


def _is_clear(left: Float, other: Float, is_known: bool) -> bool:
    """Whether what is left is far less than by another explanation; of what is known already, whether it is less."""
    if is_known:
        return trimmed(left) < trimmed(other)
    most_agree = float(np.mean(left < other)) >= AGREEING_SHARE_MIN
    return (
        trimmed(left) <= FAR_LESS_RATIO * trimmed(other) and most_agree and gain_sigmas(other, left) >= GAIN_MIN_SIGMAS
    )


def _mixed_frames(motions: Motions) -> CameraVerdict | None:
    """Whether orientations agree with the pictures and positions do not, whatever the camera."""
    angles_rad = direction_angles_rad(motions, np.eye(3))[motions.has_direction & motions.is_seen]
    turns_agree = trimmed(turn_costs(motions, np.eye(3))) < 1.0
    if not turns_agree or len(angles_rad) < PAIRS_MIN or float(np.median(angles_rad)) < MIXED_ANGLE_MIN_RAD:
        return None
    return CameraVerdict(CameraFault.MIXED_FRAMES, 1.0, np.eye(3), len(angles_rad))


def _vertex(left: dict[int, float], best: int) -> float:
    """Where between the steps the least is, by a parabola through the best and those beside it; 0 at the border."""
    if best - 1 not in left or best + 1 not in left:
        return 0.0
    below, at, above = left[best - 1], left[best], left[best + 1]
    curvature = below - 2.0 * at + above
    return float(np.clip(0.5 * (below - above) / curvature, -0.5, 0.5)) if curvature > 1e-9 else 0.0


def _by_odometry(flow: Flow, inverted: bool) -> Float:
    """(4, 4) the later camera in the earlier one; where the poses given are those of the world in the camera, too."""
    if inverted:
        return flow.T_odom_before @ inverse(flow.T_odom_now)
    return between(flow.T_odom_before, flow.T_odom_now)
