"""Seen from above: trajectories against ground truth, and where closures joined them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse
from flocc_launch.report.album import EMPTY, Album
from flocc_launch.report.shown_pairs import anchor
from flocc_launch.report.svg import PALETTE_SIZE, Axis, element, nice_step, path, svg, text_of, title
from flocc_launch.runs.closure_table import Pair
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.plain_numbers import number
from flocc_launch.runs.tracks import RobotTrack
from flocc_launch.runs.trajectory_errors import alignment
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]

WIDTH_PX = 470.0
HEIGHT_PX_MAX = 520.0
HEIGHT_PX_MIN = 240.0
MARGIN_PX = 30.0
NAME_PX, NAME_LINE_PX = 8.0, 14.0
"""Width of a letter of a robot's name, and how far names stand below each other."""
AXIS_NAMES = "xyz"


@dataclass(frozen=True, slots=True, eq=False)
class MapScene:
    """Positions to draw, all in one frame: per robot (N, 3), NaN where unknown."""

    name: str
    caption: str
    lines_m: Mapping[str, Float]
    truth_m: Mapping[str, Float]
    with_closures: bool


@dataclass(frozen=True, slots=True)
class MapView:
    """Which two axes are drawn, and how metres become pixels."""

    across: int
    up: int
    x: Axis
    y: Axis
    height_px: float

    def __call__(self, position_m: Float) -> tuple[float, float]:
        """Pixels of a position (3,)."""
        return self.x(float(position_m[self.across])), self.y(float(position_m[self.up]))


def scenes(loaded: LoadedRun) -> list[MapScene]:
    """Before and after: in the world where ground truth is known, else in each map frame."""
    if any(track.true.any() for track in loaded.tracks.values()):
        return [before_in_world(loaded), after_in_world(loaded)]
    frames = sorted({track.map_frame for track in loaded.tracks.values() if track.map_frame is not None})
    return [scene for frame in frames for scene in in_map(loaded, frame)]


def before_in_world(loaded: LoadedRun) -> MapScene:
    """Odometry, each robot put at its true first pose."""
    lines = {}
    for robot, track in loaded.tracks.items():
        if track.true.any():
            first = int(np.argmax(track.true))
            T_world_odom = track.T_world_body[first] @ inverse(track.T_odom_body[first])
            lines[robot] = (T_world_odom @ track.T_odom_body)[:, :3, 3]
    return MapScene("Before", "Odometry alone, each robot put at its true start.", lines, truths(loaded), False)


def after_in_world(loaded: LoadedRun) -> MapScene:
    """Corrected trajectories, the robots of one map frame aligned to ground truth together."""
    lines: dict[str, Float] = {}
    frames = sorted({track.map_frame for track in loaded.tracks.values() if track.map_frame is not None})
    for frame in frames:
        members = {robot: track for robot, track in loaded.tracks.items() if track.map_frame == frame}
        pairs = [track.corrected_and_true() for track in members.values()]
        if sum(len(truth) for _, truth in pairs):
            T_world_map = alignment([estimate for estimate, _ in pairs], [truth for _, truth in pairs])
            lines |= {robot: (T_world_map @ track.T_map_body)[:, :3, 3] for robot, track in members.items()}
    together = "all robots moved together onto the truth" if len(frames) == 1 else "each map moved onto the truth"
    return MapScene("After", f"Corrected by the swarm, {together}.", lines, truths(loaded), True)


def in_map(loaded: LoadedRun, frame: str) -> list[MapScene]:
    """Odometry from its corrected start, and corrected trajectories, of the robots in one map frame."""
    members = {robot: track for robot, track in loaded.tracks.items() if track.map_frame == frame}
    before = {robot: from_corrected_start(track) for robot, track in members.items()}
    after = {robot: track.T_map_body[:, :3, 3] for robot, track in members.items()}
    return [
        MapScene(f"Before, in {frame}", "Odometry alone, from each robot's corrected start.", before, {}, False),
        MapScene(f"After, in {frame}", "Corrected by the swarm.", after, {}, True),
    ]


def from_corrected_start(track: RobotTrack) -> Float:
    """Odometry positions (N, 3) in the map frame, put at the first corrected pose."""
    if not track.corrected.any():
        return np.full((len(track), 3), np.nan)
    first = int(np.argmax(track.corrected))
    T_map_odom = track.T_map_body[first] @ inverse(track.T_odom_body[first])
    return np.asarray((T_map_odom @ track.T_odom_body)[:, :3, 3])


def truths(loaded: LoadedRun) -> dict[str, Float]:
    """True positions (N, 3) of each robot, NaN where unknown."""
    return {robot: track.T_world_body[:, :3, 3] for robot, track in loaded.tracks.items() if track.true.any()}


def view_of(shown: Iterable[MapScene]) -> MapView:
    """One view for all scenes: the plane with the largest extent, equal axes."""
    clouds = [line for scene in shown for line in (*scene.lines_m.values(), *scene.truth_m.values())]
    points = np.concatenate(clouds) if clouds else np.zeros((1, 3))
    points = points[np.isfinite(points).all(axis=1)]
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.ones(3))
    across, up = sorted(int(k) for k in np.argsort(high - low, kind="stable")[::-1][:2])
    wide, tall = (max(float(high[k] - low[k]), 1e-3) for k in (across, up))
    drawn_px = WIDTH_PX - 2 * MARGIN_PX
    scale = min(drawn_px / wide, (HEIGHT_PX_MAX - 2 * MARGIN_PX) / tall)
    height_px = max(tall * scale + 2 * MARGIN_PX, HEIGHT_PX_MIN)
    middle = (low + high) / 2
    half_x, half_y = drawn_px / 2 / scale, (height_px / 2 - MARGIN_PX) / scale
    x = Axis(middle[across] - half_x, middle[across] + half_x, MARGIN_PX, WIDTH_PX - MARGIN_PX)
    y = Axis(middle[up] - half_y, middle[up] + half_y, height_px - MARGIN_PX, MARGIN_PX)
    return MapView(across, up, x, y, height_px)


def map_figure(scene: MapScene, view: MapView, loaded: LoadedRun, album: Album = EMPTY) -> str:
    """Draw one scene; closures and places with pictures lead to them."""
    robots = list(loaded.robots)
    layers = [element("rect", x=0.5, y=0.5, width=WIDTH_PX - 1, height=view.height_px - 1, rx=8, class_="frame")]
    truth = "".join(line_of(points, view, "truth") for points in scene.truth_m.values())
    layers.append(element("g", truth, class_="truth-layer"))
    for robot, points in scene.lines_m.items():
        layers.append(element("g", line_of(points, view, "track"), class_=colour(robots, robot)))
    if scene.with_closures:
        layers.append(pairs_layer(scene, view, loaded, album))
        layers.append(views_layer(scene, view, loaded, album))
    layers.extend(starts_of(scene, view, robots))
    layers.append(scale_bar(view))
    layers.append(compass(view))
    return svg(WIDTH_PX, view.height_px, *layers, label=f"{scene.name}: {scene.caption}")


def colour(robots: Sequence[str], robot: str) -> str:
    """Colour class of a robot: by its place among the robots of the run."""
    return f"c{robots.index(robot) % PALETTE_SIZE}" if robot in robots else f"c{PALETTE_SIZE - 1}"


def line_of(points_m: Float, view: MapView, class_: str) -> str:
    """A line through the known points; it breaks where one is unknown."""
    known = np.asarray(np.isfinite(points_m).all(axis=1))
    pieces = np.split(np.arange(len(points_m)), np.flatnonzero(~known))
    runs = [piece[known[piece]] for piece in pieces]
    return "".join(path((view(points_m[i]) for i in run), class_) for run in runs if len(run))


def starts_of(scene: MapScene, view: MapView, robots: Sequence[str]) -> list[str]:
    """A dot and the robot's name where each line starts; names of one place stand below each other."""
    taken: list[tuple[float, float, float]] = []
    drawn = []
    for robot, points_m in scene.lines_m.items():
        known = points_m[np.isfinite(points_m).all(axis=1)]
        if not len(known):
            continue
        x, y = view(known[0])
        width = NAME_PX * len(robot)
        right = x + width < WIDTH_PX - 20
        low = x + 9 if right else x - 9 - width
        name_y = free_y(y - 7, low, low + width, taken)
        taken.append((low, low + width, name_y))
        name = element(
            "text", text_of(robot), x=x + (9 if right else -9), y=name_y, class_="name",
            text_anchor="start" if right else "end",
        )  # fmt: skip
        drawn.append(element("g", element("circle", cx=x, cy=y, r=5, class_="dot"), name, class_=colour(robots, robot)))
    return drawn


def free_y(wished: float, low: float, high: float, taken: Sequence[tuple[float, float, float]]) -> float:
    """The first height at or below the wished one at which a name from `low` to `high` hides no other one."""
    y = wished
    for other_low, other_high, other_y in sorted(taken, key=lambda name: name[2]):
        if low < other_high and other_low < high and abs(y - other_y) < NAME_LINE_PX:
            y = other_y + NAME_LINE_PX
    return y


def pairs_layer(scene: MapScene, view: MapView, loaded: LoadedRun, album: Album) -> str:
    """Accepted closures coloured by probability, rejected candidates as crosses."""
    accepted, rejected = [], []
    sheets = {(each.pair.query, each.pair.match): each.name for each in album.pairs}
    for pair in loaded.pairs:
        ends = [position_of(scene, loaded, keyframe) for keyframe in (pair.query, pair.match)]
        if ends[0] is None or ends[1] is None:
            continue
        sheet = sheets.get((pair.query, pair.match))
        if pair.accepted:
            accepted.append(linked(closure_mark(pair, view(ends[0]), view(ends[1])), sheet))
        elif pair.rejected:
            rejected.append(linked(cross(pair, view(ends[0])), sheet))
    return element("g", *rejected, class_="rejected") + element("g", *accepted, class_="accepted")


def linked(mark: str, name: str | None) -> str:
    """A mark that opens a pair's pictures, where it has some."""
    return mark if name is None else element("a", mark, href=f"#{name}")


def views_layer(scene: MapScene, view: MapView, loaded: LoadedRun, album: Album) -> str:
    """Numbers where the pictures along the way were taken."""
    numbers: dict[str, int] = {}
    marks = []
    for keyframe in album.views:
        robot = keyframe.log.robot
        numbers[robot] = numbers.get(robot, 0) + 1
        position_m = position_of(scene, loaded, keyframe)
        if position_m is not None:
            x, y = view(position_m)
            disc = element("circle", cx=x, cy=y, r=6.5, class_="dot")
            digit = element("text", str(numbers[robot]), x=x, y=y + 3.4, class_="digit", text_anchor="middle")
            link = element("a", disc, digit, href=f"#view-{anchor(keyframe)}")
            marks.append(element("g", link, class_=colour(list(loaded.robots), robot)))
    return element("g", *marks, class_="views")


def position_of(scene: MapScene, loaded: LoadedRun, keyframe: KeyframeId) -> Float | None:
    """Where a keyframe is drawn, None where it is not."""
    points, track = scene.lines_m.get(keyframe.log.robot), loaded.tracks.get(keyframe.log.robot)
    if points is None or track is None or keyframe.log.incarnation != track.incarnation:
        return None
    position_m = points[keyframe.index] if keyframe.index < len(points) else np.full(3, np.nan)
    return position_m if bool(np.isfinite(position_m).all()) else None


def closure_mark(pair: Pair, query_px: tuple[float, float], match_px: tuple[float, float]) -> str:
    """A line between both keyframes and a dot at its middle."""
    (x1, y1), (x2, y2) = query_px, match_px
    said = f"{pair.query} – {pair.match}: match ratio {number(pair.ratio)}, probability {number(pair.probability)}"
    said += ", not used by the solver" if pair.used is False else ""
    dot = element("circle", cx=(x1 + x2) / 2, cy=(y1 + y2) / 2, r=3.6, class_=f"q{step_of(pair.probability)}")
    return element(
        "g",
        title(said),
        element("line", x1=x1, y1=y1, x2=x2, y2=y2),
        dot,
        class_="closure unused" if pair.used is False else "closure",
    )


def step_of(probability: float | None) -> int:
    """Colour step 0 to 4 of a probability; the middle where it is not known."""
    return 2 if probability is None else min(int(probability * 5), 4)


def cross(pair: Pair, at_px: tuple[float, float]) -> str:
    """A cross where a candidate was rejected."""
    x, y = at_px
    d = f"M{x - 3:.1f} {y - 3:.1f}l6 6m0 -6l-6 6"
    return element("path", title(f"{pair.query} – {pair.match}: {pair.reason}"), d=d, class_="cross")


def scale_bar(view: MapView) -> str:
    """A bar of a round length, at the bottom left."""
    metres_per_px = (view.x.high - view.x.low) / (view.x.to_px - view.x.from_px)
    length_m = nice_step(60 * metres_per_px)
    end, y = 14 + length_m / metres_per_px, view.height_px - 12
    bar = element("path", d=f"M14 {y - 4:.1f}v4H{end:.1f}v-4", class_="axis", fill="none")
    return bar + element("text", f"{length_m:g} m", x=end + 6, y=y + 1, class_="soft", font_size=12)


def compass(view: MapView) -> str:
    """Which axes are drawn, at the bottom right."""
    text = f"{AXIS_NAMES[view.across]} →  {AXIS_NAMES[view.up]} ↑"
    return element("text", text, x=WIDTH_PX - 12, y=view.height_px - 11, class_="soft", text_anchor="end", font_size=12)
