"""g2o files: SE(3) edges with quaternions and SE(2) edges, in and out.

Two-dimensional graphs are lifted into the plane z = 0 with unit information on what a plane does not have. A folder
holds one file per robot (keys of all robots in their top byte), and maybe a `*_groundTruth.txt` with `x,y,theta` of
all keyframes, robot after robot.
"""

import codecs
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph
from flocc_agent.geometry import R_from_q_wxyz, pose, q_wxyz_from_R, so3_exp
from flocc_launch.graph_files.graph_file import (
    INDEX_BITS,
    GraphFile,
    GraphFileError,
    Measurement,
    distinct,
    isotropic_noise,
    isotropic_of,
    log_of,
    pose_graph,
)
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

SE3_NUMBERS, SE2_NUMBERS = 7 + 21, 3 + 6
EDGES = ("EDGE_SE3:QUAT", "EDGE_SE2")
VERTICES = {"VERTEX_SE3:QUAT": 7, "VERTEX_SE2": 3}
KNOWN = {*EDGES, *VERTICES, "FIX"}
COMMENTS = ("#", "%", "//")
NAMED_MAX = 5
SIGMA_MIN, SIGMA_MAX, CONDITION_MAX = 1e-10, 1e10, 1e13
"""Standard deviations (m, rad), and ratio of the largest variance to the smallest, of what a solver can weigh."""
FREE_RATIO = 1e10
STRONGEST_RATIO, WEAK_INFORMATION = 1e6, 1e-6
"""From here on LM and GNC end early: an edge so much stronger than the median one, and a median so weak."""
ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def read_g2o(path: Path, isotropic: bool = False) -> GraphFile:
    """Read a g2o file, or all robots' files of a folder; with `isotropic` noise as SE-Sync reduces it.

    Raises:
        GraphFileError: A file is missing or a line is damaged; the message names both.
    """
    files = _robot_files(path) if path.is_dir() else [path]
    lines = [line for file in files for line in _lines(file)]
    planar = all(line.words[0] != "EDGE_SE3:QUAT" for line in lines)
    read = (_measurement(line, isotropic, planar) for line in lines)
    measurements = distinct((m for m in read if m is not None), add_up=True)
    left_out = Counter(line.words[0] for line in lines if line.words[0] not in KNOWN)
    if not measurements:
        there = ", ".join(f"{count} of kind {kind[:30]}" for kind, count in left_out.most_common(NAMED_MAX))
        raise GraphFileError(f"{path}: has no edges {' or '.join(EDGES)}" + (f", but lines {there}" if there else ""))
    graph = pose_graph(measurements, str(path))
    keys = {key for m in measurements for key in (m.first, m.second)}
    vertices, notes = _vertices(lines, keys)
    fixed, fix_notes = _fixed(lines, vertices, keys)
    return GraphFile(
        graph,
        _truth(path, graph) if path.is_dir() else {},
        T_initial=_initial(vertices, graph),
        planar=planar,
        left_out=left_out,
        fixed=fixed,
        notes=(*notes, *fix_notes, *_weight_notes(measurements, planar)),
        vertices={log: tuple(of_log) for log, of_log in _by_log(keys).items()},
    )


def _robot_files(folder: Path) -> list[Path]:
    files = sorted(file for file in folder.glob("*.g2o") if file.stem.isdigit())
    if not files:
        raise GraphFileError(f"{folder}: has no files 0.g2o, 1.g2o, ... of robots")
    return files


@dataclass(frozen=True, slots=True)
class Line:
    """The words of a line that is not empty, and where it is."""

    path: Path
    number: int
    words: list[str]


def _lines(path: Path) -> Iterable[Line]:
    for number, line in enumerate(_text(path).splitlines(), 1):
        words = line.split("#")[0].split()
        if words and not words[0].startswith(COMMENTS):
            yield Line(path, number, words)


def _text(path: Path) -> str:
    """Text of a file: only comments have other letters than ASCII, so that their encoding does not count."""
    try:
        data = path.read_bytes()
        marked = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = data.decode("utf-16") if marked else data.decode("utf-8-sig", errors="replace")
    except (OSError, UnicodeDecodeError) as error:
        raise GraphFileError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if "\0" in text:
        raise GraphFileError(f"{path}: cannot be read: is not text")
    return text


def _measurement(line: Line, isotropic: bool, planar: bool) -> Measurement | None:
    """The edge of a line; None where it has none."""
    kind, *numbers = line.words
    if kind not in EDGES:
        return None
    try:
        return _se3(numbers, isotropic) if kind == "EDGE_SE3:QUAT" else _se2(numbers, isotropic, planar)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise GraphFileError(f"{line.path}: line {line.number}: {error}") from error


def _key(word: str) -> int:
    """A vertex's key.

    Raises:
        ValueError: It is none.
    """
    key = int(word)
    if not 0 <= key < 2**64:
        raise ValueError(f"{key} is no key of a vertex")
    return key


def _vertex(line: Line) -> tuple[int, Float] | None:
    """Key and pose of a vertex line; None where it has none."""
    kind, *numbers = line.words
    if kind not in VERTICES:
        return None
    words = " ".join(numbers[1 : SE3_NUMBERS + 1])
    try:
        key, *v = _key(numbers[0]), *(float(number) for number in numbers[1:])
        if len(v) != VERTICES[kind] or not np.all(np.isfinite(v)):
            raise ValueError(f"a vertex has {VERTICES[kind]} finite numbers after its key, this one [{words}]")
        if kind == "VERTEX_SE2":
            return key, pose(so3_exp(np.array([0.0, 0.0, v[2]])), np.array([v[0], v[1], 0.0]))
        return key, pose(R_from_q_wxyz(np.array(v)[[6, 3, 4, 5]]), np.array(v[:3]))
    except (ValueError, IndexError) as error:
        raise GraphFileError(f"{line.path}: line {line.number}: {error}") from error


def _vertices(lines: Iterable[Line], keys: Set[int]) -> tuple[dict[int, Float], list[str]]:
    """Poses of the vertices that edges join, and what is said of others and of those that occur twice."""
    found: dict[int, Float] = {}
    again, alone = dict[int, None](), dict[int, None]()
    for line in lines:
        if (vertex := _vertex(line)) is None:
            continue
        key, T = vertex
        if key in found and not np.array_equal(found[key], T):
            again[key] = None
        if key not in keys:
            alone[key] = None
        found[key] = T
    notes = [f"{_named('vertex', again)}: given more than once, the last pose counts"] if again else []
    notes += [f"{_named('vertex', alone)}: no edge joins it, left out"] if alone else []
    return {key: T for key, T in found.items() if key in keys}, notes


def _named(what: str, keys: Collection[int]) -> str:
    more = f" and {len(keys) - NAMED_MAX} more" if len(keys) > NAMED_MAX else ""
    return f"{what} {', '.join(str(key) for key in list(keys)[:NAMED_MAX])}{more}"


def _weight_notes(measurements: Sequence[Measurement], planar: bool) -> list[str]:
    """What is said of information with which a solver may not find the minimum."""
    used = [2, 3, 4] if planar else list(range(6))
    information = 1.0 / np.array([np.diag(m.covariance)[used] for m in measurements])
    usual = np.median(information, axis=0)
    k = int(np.argmax((information / usual).max(axis=1)))
    notes = []
    if (information[k] > STRONGEST_RATIO * usual).any():
        notes.append(
            f"the edge from vertex {measurements[k].first} to {measurements[k].second} has over {STRONGEST_RATIO:g} "
            "times the information of the usual edge: the solve may end early, and right closures be let go"
        )
    if (usual < WEAK_INFORMATION).all():
        notes.append(f"information is as small as {usual.min():g}: lm ends before the minimum; scale it up")
    return notes


def _fixed(
    lines: Sequence[Line], vertices: Mapping[int, Float], keys: Set[int]
) -> tuple[tuple[KeyframeId, ...], list[str]]:
    """Keyframes of `FIX` lines, where the vertices say their place, and what is said of others."""
    fixed: dict[int, None] = {}
    for line in lines:
        try:
            fixed |= dict.fromkeys(_key(word) for word in line.words[1:] if line.words[0] == "FIX")
        except ValueError as error:
            raise GraphFileError(f"{line.path}: line {line.number}: {error}") from error
    found = [key for key in fixed if key in vertices]
    lost = [key for key in fixed if key not in vertices]
    before = {key: sum(other < key and log_of(other) == log_of(key) for other in keys) for key in found[:NAMED_MAX]}
    notes = [f"{_named('FIX', lost)}: no vertex with an edge says where that is, nothing is held there"] if lost else []
    if len(found) > 1:
        notes.append(f"{_named('FIX', found)}: the first of them that is joined places the result, none holds it")
    return tuple(KeyframeId(log_of(key), count) for key, count in before.items()), notes


def _initial(vertices: Mapping[int, Float], graph: PoseGraph) -> dict[LogId, Float]:
    """Poses of each log whose vertices are all there, in the order of their keys."""
    by_log = _by_log(vertices)
    whole = {log: keys for log, keys in by_log.items() if len(keys) == len(graph.trajectories.get(log, ()))}
    return {log: np.array([vertices[key] for key in keys]) for log, keys in whole.items()}


def _by_log(keys: Iterable[int]) -> dict[LogId, list[int]]:
    """Keys of each log, in their order."""
    by_log: dict[LogId, list[int]] = {}
    for key in sorted(keys):
        by_log.setdefault(log_of(key), []).append(key)
    return by_log


def _numbers(words: list[str], count: int) -> tuple[int, int, Float]:
    if len(words) != 2 + count:
        raise ValueError(f"an edge has {len(words)} fields, expected {2 + count}")
    values = np.array([float(word) for word in words[2:]])
    if not np.all(np.isfinite(values)):
        raise ValueError("an edge has a value that is not finite")
    return _key(words[0]), _key(words[1]), values


def _symmetric(upper: Float, size: int) -> Float:
    out = np.zeros((size, size))
    out[np.triu_indices(size)] = upper
    return np.asarray(out + np.triu(out, 1).T)


def _se3(words: list[str], isotropic: bool) -> Measurement:
    """One `EDGE_SE3:QUAT`: quaternion x y z w, information with translation first."""
    first, second, v = _numbers(words, SE3_NUMBERS)
    T = pose(R_from_q_wxyz(v[[6, 3, 4, 5]]), v[:3])
    information = _symmetric(v[7:], 6)[np.ix_(ROTATION_FIRST, ROTATION_FIRST)]
    return Measurement(first, second, T, isotropic_of(information) if isotropic else _covariance(information))


def _covariance(information: Float) -> Float:
    """The inverse of an information matrix.

    Raises:
        ValueError: It is not positive definite, or no solver can weigh it.
    """
    eigenvalues = np.linalg.eigvalsh(information)
    low, high = float(eigenvalues[0]), float(eigenvalues[-1])
    if low <= 0.0:
        raise ValueError("the information matrix is not positive definite")
    if high > CONDITION_MAX * low or low < SIGMA_MAX**-2 or high > SIGMA_MIN**-2:
        raise ValueError(
            f"the information matrix has eigenvalues from {low:g} to {high:g}; they must lie between {SIGMA_MAX**-2:g} "
            f"and {SIGMA_MIN**-2:g}, the largest at most {CONDITION_MAX:g} times the smallest"
        )
    return np.asarray(np.linalg.inv(information))


def _se2(words: list[str], isotropic: bool, planar: bool) -> Measurement:
    first, second, v = _numbers(words, SE2_NUMBERS)
    T = pose(so3_exp(np.array([0.0, 0.0, v[2]])), np.array([v[0], v[1], 0.0]))
    planar_covariance = _covariance(_symmetric(v[3:], 3))
    variances = np.linalg.eigvalsh(planar_covariance)
    covariance = np.eye(6) * np.clip(1.0, variances[-1] / FREE_RATIO, variances[0] * FREE_RATIO)
    in_plane = np.ix_([3, 4, 2], [3, 4, 2])
    covariance[in_plane] = planar_covariance
    return Measurement(first, second, T, isotropic_noise(covariance, planar) if isotropic else covariance)


def _truth(folder: Path, graph: PoseGraph) -> dict[LogId, Float]:
    """True positions of all robots, cut from one list in the order of the robots."""
    file = next(iter(sorted(folder.glob("*_groundTruth.txt"))), None)
    if file is None:
        return {}
    try:
        rows = np.loadtxt(file, delimiter=",", ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise GraphFileError(f"{file}: is no table x,y,theta: {getattr(error, 'strerror', None) or error}") from error
    if rows.shape[1] < 2:
        raise GraphFileError(f"{file}: is no table x,y,theta: a row has {rows.shape[1]} numbers")
    positions = np.column_stack([rows[:, 0], rows[:, 1], np.zeros(len(rows))])
    truth, start = {}, 0
    for log in sorted(graph.trajectories):
        truth[log] = positions[start : start + len(graph.trajectories[log])]
        start += len(graph.trajectories[log])
    if start > len(positions):
        raise GraphFileError(f"{file}: has {len(positions)} poses, the robots have {start} keyframes")
    return truth


def write_g2o(
    path: Path,
    T_keyframe: Mapping[LogId, Float],
    closures: Iterable[LoopClosure] = (),
    vertices: Mapping[LogId, Sequence[int]] | None = None,
) -> None:
    """Write poses (N, 4, 4) of every log and the metric closures between them.

    Odometry edges join consecutive poses as they are. A covariance that is not given is written as unit information.

    Args:
        path: The file.
        T_keyframe: Poses.
        closures: Between them.
        vertices: The number of every keyframe; without them keys carry the robot's number (from `a` on, in the order
            of the logs) in their top byte.

    Raises:
        GraphFileError: The file cannot be written.
    """
    firsts = {log: (ord("a") + n) << INDEX_BITS for n, log in enumerate(sorted(T_keyframe))}

    def key(keyframe: KeyframeId) -> int:
        return vertices[keyframe.log][keyframe.index] if vertices else firsts[keyframe.log] | keyframe.index

    posed = [(KeyframeId(log, k), T) for log in sorted(T_keyframe) for k, T in enumerate(T_keyframe[log])]
    lines = [vertex_line(key(keyframe), T) for keyframe, T in posed]
    for log in sorted(T_keyframe):
        for k, (T_first, T_second) in enumerate(pairwise(T_keyframe[log])):
            ends = key(KeyframeId(log, k)), key(KeyframeId(log, k + 1))
            lines.append(edge_line(*ends, np.linalg.solve(T_first, T_second), np.eye(6)))
    for c in closures:
        covariance = np.eye(6) if c.covariance is None else c.covariance
        information: Float = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        lines.append(edge_line(key(c.query), key(c.match), c.T_query_match_unscaled, information))
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise GraphFileError(f"{path}: cannot be written: {error.strerror or error}") from error


def vertex_line(vertex: int, T: Float) -> str:
    """One vertex: its pose (4, 4) as `x y z qx qy qz qw`."""
    return f"VERTEX_SE3:QUAT {vertex} {_seven(T)}"


def edge_line(first: int, second: int, T: Float, information: Float) -> str:
    """One edge: the pose (4, 4) of the second in the first, information (6, 6) with rotation first.

    g2o has translation first, of the information its upper triangle.
    """
    upper = information[np.ix_(ROTATION_FIRST, ROTATION_FIRST)][np.triu_indices(6)]
    return f"EDGE_SE3:QUAT {first} {second} {_seven(T)} {' '.join(repr(float(v)) for v in upper)}"


def _seven(T: Float) -> str:
    q = q_wxyz_from_R(T[:3, :3])
    return " ".join(repr(float(v)) for v in [*T[:3, 3], *q[1:], q[0]])
