"""Whether pictures turn and move as the trajectory says that the camera did.

A file can say of its columns what they are not: then a header is believed, and every rotation is another one of the
same size. Nothing but the pictures shows it. Turns and directions of motion between pictures that follow each other
are held against the trajectory as it was read, and as it would read with the quaternion in the other order. Anything
else that is wrong with the camera or the trajectory is told as a running robot tells it (`perception.watch`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import Image
from flocc_agent.geometry import angle_rad, between, q_wxyz_from_R
from flocc_agent.perception.backends import build_perception
from flocc_agent.perception.watch.camera_verdict import (
    CameraFault,
    CameraVerdict,
    WatchedPair,
    camera_verdict,
    evidence,
    shows_camera,
)
from flocc_agent.perception.watch.camera_watch import SeesFlow
from flocc_agent.perception.watch.mount_fit import Motions, constant_turn, costs, motions_of, trimmed, turn_costs
from flocc_agent.perception.watch.seen_motion import Flow, SeenMotion
from flocc_agent.runtime.picture_heads import PictureError
from flocc_agent.runtime.pictures import read_picture
from flocc_agent.runtime.quaternion_order import rotations
from flocc_agent.runtime.straightening import Straightener
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.source import DatasetError, Source

Float = NDArray[np.float64]

PAIRS_MAX = 10
"""Pairs that are looked at; each costs two pictures' features."""
TURN_WANTED_RAD, TURN_MAX_RAD = float(np.radians(3.0)), float(np.radians(20.0))
"""Between the two pictures of a pair: enough to be seen, not so much that they show different things."""
APART_MAX = 40
"""Pictures that are passed over for one that has turned enough."""
WRONG_MIN = 4.0
"""Mean disagreement of a reading that pictures contradict, whatever the mounting; bad odometry that is read right
leaves 0.1 to 6, one in the other order 5 to 31 (windows of sevenscenes and street)."""
BETTER_MIN_RATIO = 2.5
"""How much less the other reading must leave; it leaves a quarter at most where it is right."""
PREFER_MIN_RATIO = 0.75
"""Of the pairs those that must prefer the other reading."""
OFFSET_MAX_S, OFFSET_STEP_S, OFFSET_MIN_S = 2.0, 0.1, 0.15
"""Differences of clocks that are tried, and what is told; `clocks` measures them over all pictures and any range."""
OFFSET_PAIRS_MIN, OFFSET_EVIDENCE_MIN = 5, 8.0
ORDERS = {-1: ("x y z w", "w x y z", "tum-wxyz"), 1: ("w x y z", "x y z w", "tum")}
"""By how many places a quaternion's numbers move round: how they were read, how they must be, and the form's name."""
POSED_BY_MATRICES = ("kitti", "7scenes", "colmap", "transforms", "replica")
"""Formats without quaternions whose order a line of the file could say wrongly."""
WAY_OUT = "flocc dataset convert --trajectory-format"


@dataclass(frozen=True, slots=True)
class PictureVerdict:
    """What pictures say of a trajectory.

    Attributes:
        order: Of `ORDERS`, where only the quaternion's other order fits them.
        camera: What else is wrong, as a running robot would tell it.
        pairs: Of pictures that say so.
        later_s: How much later the trajectory turns by its stamps than the pictures do, where that explains them.
    """

    order: int | None
    camera: CameraVerdict | None
    pairs: int
    later_s: float | None = None


def seen_faults(source: Source, trajectory: Trajectory, is_settled: bool = False) -> tuple[str, ...]:
    """What pictures contradict of a trajectory, one sentence each.

    Args:
        source: Images and lens.
        trajectory: Of the body.
        is_settled: Whether a person has named the order of quaternions.

    Raises:
        DatasetError: They contradict the order of the quaternions, which nobody has settled.
    """
    pairs = posed_pairs(source, trajectory)
    verdict = verdict_of(pairs, trajectory) if pairs else None
    if verdict is not None and verdict.later_s is not None:
        when = "later" if verdict.later_s > 0 else "earlier"
        return (
            f"{source.path}: the trajectory turns about {abs(verdict.later_s):.1f} s {when} than the pictures do "
            f"({verdict.pairs} pairs of pictures): their clocks differ; flocc dataset clock measures by how much, and "
            "--time-offset mends it",
        )
    if verdict is None or (verdict.order is not None and source.format in POSED_BY_MATRICES):
        return ()
    if verdict.camera is not None:
        return (f"{source.path}: {_told(verdict.camera)} ({verdict.pairs} pairs of pictures)",)
    assert verdict.order is not None
    read, other, form = ORDERS[verdict.order]
    sentence = (
        f"{source.path}: the quaternions were read as {read}, but the pictures turn as they do read as {other} "
        f"({verdict.pairs} pairs of pictures)"
    )
    if is_settled:
        return (f"{sentence}; {read} was named, and is taken",)
    kept = next(form for said, _, form in ORDERS.values() if said == other)
    raise DatasetError(f"{sentence}; {WAY_OUT} {form} reads them so, {WAY_OUT} {kept} leaves them as they are")


def _told(verdict: CameraVerdict) -> str:
    """What is wrong with a camera or its trajectory."""
    turn_deg = float(np.degrees(angle_rad(verdict.X)))
    axes = "; the axes seem to be another convention's, or T_body_camera is missing" if verdict.places_wrongly else ""
    turned = f"the camera is turned by {turn_deg:.0f} degrees against T_body_camera{axes}"
    focal = f"the focal length is {verdict.focal_factor:.2f} times that of the calibration"
    sentences = {
        CameraFault.FOCAL_LENGTH: focal,
        CameraFault.MOUNTING: turned,
        CameraFault.BOTH: f"{focal}, and {turned}",
        CameraFault.MIRRORED: "the pictures are mirrored",
        CameraFault.INVERTED_POSES: "the poses are the world in the body, by the pictures: invert them",
        CameraFault.MIXED_FRAMES: (
            "positions and orientations are of different frames (ENU and NED, or body and camera), by the pictures"
        ),
    }
    return f"pictures and trajectory do not go together: {sentences[verdict.fault]}"


def verdict_of(pairs: Sequence["PosedPair"], trajectory: Trajectory | None = None) -> PictureVerdict | None:
    """What pairs say; None where they agree with the trajectory, or tell nothing.

    Args:
        pairs: Matches with poses.
        trajectory: That the poses are of, to see whether it fits at other times; None looks at nothing else.
    """
    watched = [WatchedPair(pair.flow) for pair in pairs]
    if not shows_camera(watched):
        return None
    seen = [pair.motion(1.0, False) for pair in watched]
    given = motions_of(seen, [between(pair.flow.T_odom_before, pair.flow.T_odom_now) for pair in pairs])
    left = least_costs(given)
    if trimmed(left) > WRONG_MIN:
        for order in ORDERS:
            other = least_costs(motions_of(seen, [pair.shifted(order) for pair in pairs]))
            is_better = BETTER_MIN_RATIO * trimmed(other) < trimmed(left)
            if is_better and float(np.mean(other < left)) >= PREFER_MIN_RATIO:
                return PictureVerdict(order, None, len(pairs))
    if trajectory is not None and (later_s := _clocks_apart_s(pairs, seen, trajectory)) is not None:
        return PictureVerdict(None, None, len(pairs), later_s)
    verdict = camera_verdict(watched)
    return None if verdict is None else PictureVerdict(None, verdict, len(pairs))


def _clocks_apart_s(
    pairs: Sequence["PosedPair"], seen: Sequence[SeenMotion | None], trajectory: Trajectory
) -> float | None:
    """How much later a trajectory turns than the pictures; None where its own times explain them, or no others do.

    Only pairs that it covers at every time that is tried are looked at.
    """
    offsets_s = np.arange(-OFFSET_MAX_S, OFFSET_MAX_S + OFFSET_STEP_S / 2, OFFSET_STEP_S)
    moved = {round(float(o), 3): [pair.at_another_time(trajectory, float(o)) for pair in pairs] for o in offsets_s}
    whole = [k for k in range(len(pairs)) if all(each[k] is not None for each in moved.values())]
    if len(whole) < OFFSET_PAIRS_MIN:
        return None
    left = {
        offset_s: turn_costs(
            motions_of([seen[k] for k in whole], [T for k in whole if (T := each[k]) is not None]), np.eye(3)
        )
        for offset_s, each in moved.items()
    }
    best_s = min(left, key=lambda offset_s: trimmed(left[offset_s]))
    own, other = left[0.0], left[best_s]
    explains = BETTER_MIN_RATIO * trimmed(other) < trimmed(own) and evidence(own, other) > OFFSET_EVIDENCE_MIN
    if abs(best_s) < OFFSET_MIN_S or not explains or float(np.mean(other < own)) < PREFER_MIN_RATIO:
        return None
    return best_s


def least_costs(motions: Motions) -> Float:
    """(N,) costs under the better of the mounting as it is given and the one that fits best."""
    return min((costs(motions, X) for X in (np.eye(3), constant_turn(motions))), key=trimmed)


@dataclass(frozen=True, slots=True, eq=False)
class PosedPair:
    """Two pictures' matches, with the poses of the body.

    Attributes:
        flow: Matches, with the camera's poses as the trajectory was read.
        T_before: (4, 4) pose of the body at the first.
        T_now: (4, 4) at the second.
        T_body_camera: (4, 4).
        before_s: Stamp of the first picture.
        now_s: Of the second.
    """

    flow: Flow
    T_before: Float
    T_now: Float
    T_body_camera: Float
    before_s: float = 0.0
    now_s: float = 0.0

    def at_another_time(self, trajectory: Trajectory, offset_s: float) -> Float | None:
        """(4, 4) the second camera in the first, had both been taken so much later; None where no pose is there."""
        a, b = trajectory.at(self.before_s + offset_s), trajectory.at(self.now_s + offset_s)
        return None if a is None or b is None else between(a @ self.T_body_camera, b @ self.T_body_camera)

    def shifted(self, places: int) -> Float:
        """(4, 4) the second camera in the first, had the quaternions' numbers been taken in another order."""
        a, b = (reordered(T, places) @ self.T_body_camera for T in (self.T_before, self.T_now))
        return between(a, b)


def reordered(T: Float, places: int) -> Float:
    """A pose whose quaternion w x y z is that of `T` moved round by so many places."""
    turned = np.array(T)
    turned[:3, :3] = rotations(np.roll(q_wxyz_from_R(T[:3, :3]), places)[None])[0]
    return turned


def posed_pairs(source: Source, trajectory: Trajectory) -> list[PosedPair] | None:
    """Pairs of pictures between which the camera turns, from all over the recording; None where nothing can be seen."""
    chosen, lens = chosen_pairs(source.images, trajectory), source.lens
    if lens is None or not chosen:
        return None
    registrar_of = build_perception(PerceptionConfig())
    registrar = registrar_of.registrar
    if not isinstance(registrar, SeesFlow):
        return None
    try:
        straightener = Straightener(lens.camera, lens.view_rad)
    except ValueError:
        return None
    latents: dict[Path, bytes | None] = {}
    found = []
    for before, now in chosen:
        for _, file in (before, now):
            if file not in latents:
                image = _image(file, source, straightener)
                latents[file] = None if image is None else registrar_of.encode(image)
        a, b = latents[before[1]], latents[now[1]]
        T_before, T_now = trajectory.at(before[0]), trajectory.at(now[0])
        if a is None or b is None or T_before is None or T_now is None:
            continue
        T = lens.T_body_camera
        flow = registrar.flow(a, b, T_before @ T, T_now @ T)
        if flow is not None:
            found.append(PosedPair(flow, T_before, T_now, T, before[0], now[0]))
    return found


def chosen_pairs(
    images: Sequence[tuple[float, Path]], trajectory: Trajectory
) -> list[tuple[tuple[float, Path], tuple[float, Path]]]:
    """At most `PAIRS_MAX` pairs, of which the second has turned enough against the first."""
    chosen: list[tuple[tuple[float, Path], tuple[float, Path]]] = []
    for start in np.unique(np.linspace(0, len(images) - 1, 2 * PAIRS_MAX).astype(int)):
        T_before = trajectory.at(images[start][0])
        if T_before is None:
            continue
        for now in images[start + 1 : start + 1 + APART_MAX]:
            T_now = trajectory.at(now[0])
            turn_rad = 0.0 if T_now is None else angle_rad(between(T_before, T_now)[:3, :3])
            if turn_rad > TURN_MAX_RAD:
                break
            if turn_rad >= TURN_WANTED_RAD:
                chosen.append((images[start], now))
                break
    kept = np.unique(np.linspace(0, len(chosen) - 1, min(len(chosen), PAIRS_MAX)).astype(int))
    return [chosen[k] for k in kept]


def _image(file: Path, source: Source, straightener: Straightener) -> Image | None:
    model = straightener.model
    try:
        pixels = read_picture(file.read_bytes(), (model.width, model.height), source.levels)
    except (OSError, PictureError):
        return None
    return Image(straightener.apply(pixels), straightener.camera)
