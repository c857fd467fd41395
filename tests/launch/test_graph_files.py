"""Claims about pose-graph files and `flocc optimise`: what was written is read, damage is named, references are met."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent.config import Formulation, Solver
from flocc_agent.core.pose_graph import LoopClosure
from flocc_agent.geometry import pose, so3_exp
from flocc_launch.graph_files import GraphFileError, read_g2o, read_graph_file, write_g2o
from flocc_launch.graph_files.optimise import NoiseModel, OptimiseError, optimise_file
from flocc_protocol.ids import KeyframeId, LogId

Positions = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

A, B = LogId("a"), LogId("b")
EDGE = "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
COSMO = "cosmo_bench/{0}/kth_r3_00_d06_d09_d10_{0}.jrl"
OPTIMA = {
    "sphere2500": 1687.006,
    "parking-garage": 1.26252,
    "smallGrid3D": 1025.398,
    "tinyGrid3D": 18.5194,
    "CSAIL": 31.4703,
    "kitti_00": 125.681,
    "kitti_06": 35.3252,
    "MITb": 61.1541,
    "INTEL": 393.653,
    "M3500": 193.862,
    "cubicle": 717.126,
}


def data(shared: Path, *parts: str) -> Path:
    return shared.joinpath("data", *parts)


def test_poses_and_closures_come_back_from_a_written_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    T = {log: np.array([pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(4)]) for log in (A, B)}
    loop = LoopClosure(
        KeyframeId(A, 1), KeyframeId(B, 2), T[A][3], covariance=np.diag(np.arange(1.0, 7.0)), metric=True
    )
    write_g2o(tmp_path / "graph.g2o", T, [loop])
    read = read_g2o(tmp_path / "graph.g2o").graph
    (back,) = read.closures
    assert (back.query, back.match) == (loop.query, loop.match)
    assert back.covariance is not None
    np.testing.assert_allclose(back.covariance, np.diag(np.arange(1.0, 7.0)), rtol=1e-9)
    np.testing.assert_allclose(back.T_query_match_unscaled, T[A][3], atol=1e-12)
    for log in (A, B):
        np.testing.assert_allclose(
            read.trajectories[log].T_odom_keyframe, np.linalg.solve(T[log][0], T[log]), atol=1e-9
        )


def test_a_line_that_occurs_twice_counts_twice(tmp_path: Path) -> None:
    (tmp_path / "x.g2o").write_text(f"{EDGE}\n{EDGE}\n")
    (trajectory,) = read_g2o(tmp_path / "x.g2o").graph.trajectories.values()
    assert trajectory.edge_covariances is not None
    np.testing.assert_allclose(trajectory.edge_covariances[0], 0.5 * np.eye(6))


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("empty.g2o", "", "has no edges"),
        ("short.g2o", "EDGE_SE3:QUAT 0 1 1 2 3\n", "line 1"),
        ("words.g2o", EDGE.replace(" 1 0 0 0 0 0 1 1", " x 0 0 0 0 0 1 1", 1) + "\n", "line 1"),
        ("nan.g2o", EDGE.replace("0 1 1 0", "0 1 nan 0", 1) + "\n", "line 1"),
        ("gap.g2o", f"{EDGE}\n{EDGE.replace('QUAT 0 1', 'QUAT 5 6')}\n", "no odometry from keyframe 1 to 5"),
        ("bad.jrl", "{", "not JSON"),
        ("other.jrl", "{}", "not a JRL file"),
        ("none.jrl", '{"measurements": {"a": []}}', "has no measurements"),
        ("what.txt", "", "neither"),
    ],
)
def test_a_damaged_file_is_named_in_one_sentence(tmp_path: Path, name: str, text: str, complaint: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(GraphFileError, match=complaint) as raised:
        read_graph_file(path)
    assert str(path) in str(raised.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(GraphFileError, match="cannot be read"):
        read_graph_file(tmp_path / "nothing.g2o")


def test_an_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.g2o").write_text(EDGE + "\n")
    (tmp_path / "file").write_text("")
    with pytest.raises(OptimiseError, match="cannot be written"):
        optimise_file(tmp_path / "x.g2o", tmp_path / "file")


def test_result_json_holds_the_documented_keys(tmp_path: Path) -> None:
    (tmp_path / "x.g2o").write_text(EDGE + "\n")
    optimise_file(tmp_path / "x.g2o", tmp_path / "out", formulation=Formulation.BASE, solver=Solver.LM)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    expected = {"formulation", "solver", "cost_initial", "cost", "ate_m", "iterations", "solve_s", "components"}
    assert expected | {"closures_rejected"} <= set(result)
    assert result["ate_m"] is None
    assert (tmp_path / "out" / "optimised.g2o").exists()


@pytest.mark.data
@pytest.mark.parametrize("name", OPTIMA)
def test_the_listed_g2o_optima_are_met_to_six_digits(shared: Path, tmp_path: Path, name: str) -> None:
    path = data(shared, "g2o", f"{name}.g2o")
    result = optimise_file(path, tmp_path, formulation=Formulation.BASE, solver=Solver.LM, noise=NoiseModel.ISOTROPIC)
    assert result["cost"] == pytest.approx(OPTIMA[name], rel=1e-5 / 2)


@pytest.mark.data
def test_kitti_00_in_five_robots(shared: Path, tmp_path: Path) -> None:
    folder = data(shared, "g2o", "lajoie_splits", "kitti00")
    result = optimise_file(folder, tmp_path, formulation=Formulation.BASE, solver=Solver.LM, noise=NoiseModel.ISOTROPIC)
    assert len(result["components"]) == 1
    assert result["ate_m"] <= 3.0


@pytest.mark.data
@pytest.mark.parametrize(("name", "metric_m"), [("wifi", 1.880), ("proradio", 1.086)])
def test_free_scales_reach_the_metric_reference_from_odometry_frames(
    shared: Path, tmp_path: Path, name: str, metric_m: float
) -> None:
    path = data(shared, COSMO.format(name))
    ate = {
        formulation: optimise_file(
            path, tmp_path, formulation=formulation, solver=Solver.LM, unit_scale=True, drop_labelled_outliers=True
        )["ate_m"]
        for formulation in (Formulation.INDEPENDENT, Formulation.SMOOTHED)
    }
    assert ate[Formulation.INDEPENDENT] <= metric_m + 0.15
    assert ate[Formulation.SMOOTHED] <= ate[Formulation.INDEPENDENT] + 0.05


@pytest.mark.data
@pytest.mark.parametrize("name", ["wifi", "proradio"])
def test_the_default_finds_the_outliers_among_real_robots_closures(shared: Path, tmp_path: Path, name: str) -> None:
    result = optimise_file(data(shared, COSMO.format(name)), tmp_path, unit_scale=True)
    assert result["ate_odometry_m"] == pytest.approx(18.61, abs=0.01)
    assert result["ate_m"] <= 2.5
    assert result["outliers_used"] <= 0.05 * result["labelled_outliers"]


@pytest.mark.data
def test_a_right_closure_that_two_wrong_ones_contradict_and_six_others_do_not_is_not_held(
    shared: Path, tmp_path: Path
) -> None:
    """On kth_r3_00 proradio `a/661 - c/1` joins the end of a robot's way to where all began: 2.70 m without it."""
    result = optimise_file(data(shared, COSMO.format("proradio")), tmp_path)
    assert result["ate_m"] <= 1.35 * 1.09
    assert not any({c["query"], c["match"]} == {"a/661", "c/1"} for c in result["closures_excluded"])


def information(*diagonal: float, cross: tuple[int, int, float] | None = None) -> str:
    """A g2o line's upper triangle, translation first."""
    M = np.diag(diagonal)
    if cross is not None:
        i, j, value = cross
        M[i, j] = M[j, i] = value
    return " ".join(repr(float(value)) for value in M[np.triu_indices(6)])


def edge(i: int, j: int, x: float, y: float, of: str, yaw: float = 0.0) -> str:
    return f"EDGE_SE3:QUAT {i} {j} {x} {y} 0 0 0 {np.sin(yaw / 2)} {np.cos(yaw / 2)} {of}\n"


def vertex(k: int, x: float, y: float, yaw: float = 0.0) -> str:
    return f"VERTEX_SE3:QUAT {k} {x} {y} 0 0 0 {np.sin(yaw / 2)} {np.cos(yaw / 2)}\n"


def positions_of(
    tmp_path: Path, text: str, noise: NoiseModel = NoiseModel.GAUSSIAN
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    (tmp_path / "g.g2o").write_text(text)
    optimise_file(tmp_path / "g.g2o", tmp_path / "out", formulation=Formulation.BASE, solver=Solver.LM, noise=noise)
    read = read_g2o(tmp_path / "out" / "optimised.g2o")
    return np.concatenate([read.T_initial[log][:, :3, 3] for log in sorted(read.T_initial)])


def test_the_whole_information_of_an_edge_counts(tmp_path: Path) -> None:
    """By hand: along x odometry is sure (100) and the closure not (1), along y the other way round."""
    odometry, loop = information(100, 1, 1, *[1e6] * 3), information(1, 100, 1, *[1e6] * 3)
    text = edge(0, 1, 1, 0, odometry) + edge(1, 2, 1, 0, odometry) + edge(0, 2, 3, 1, loop)
    x = (2 / (2 / 100) + 3 / 1) / (1 / (2 / 100) + 1)
    y = (1 / 0.01) / (1 / 2 + 100)
    np.testing.assert_allclose(positions_of(tmp_path, text)[2, :2], [x, y], atol=1e-3)
    assert abs(positions_of(tmp_path, text, NoiseModel.ISOTROPIC)[2, 0] - x) > 0.3


def test_terms_between_rotation_and_translation_count(tmp_path: Path) -> None:
    """gtsam's LM on the same file gives (1.9916, 0.2979) and 0.2632 for y without the cross term."""
    loop = information(100, 1e4, 1e4, 1e6, 1e6, 25, cross=(1, 5, 450.0))
    odometry = information(1e2, 1e2, 1e2, 1e6, 1e6, 1e2)
    text = edge(0, 1, 1, 0, odometry) + edge(1, 2, 1, 0, odometry) + edge(0, 2, 2, 0.3, loop, yaw=0.1)
    np.testing.assert_allclose(positions_of(tmp_path, text)[2, :2], [1.9916, 0.2979], atol=2e-3)


def test_a_second_measurement_of_a_pair_counts(tmp_path: Path) -> None:
    of = information(*[1.0] * 3, *[1e6] * 3)
    text = edge(0, 1, 1, 0, of) + edge(1, 2, 1, 0, of) + edge(0, 2, 3, 0, of) + edge(0, 2, 3.3, 0, of)
    x = (2 / 2 + 3 + 3.3) / (1 / 2 + 1 + 1)
    np.testing.assert_allclose(positions_of(tmp_path, text)[2, 0], x, atol=1e-6)


@pytest.mark.parametrize("noise", NoiseModel)
def test_odometry_may_be_written_backwards(tmp_path: Path, noise: NoiseModel) -> None:
    """By hand: the turn of a backward step counts with its arm, as the same line forwards would."""
    of, sure = information(4.0, 4.0, 4.0, *[1e6] * 3), information(*[1e6] * 6)
    loop = edge(0, 2, 2.3, 0.0, of)
    forward = edge(0, 1, 1, 0, of) + edge(1, 2, 1, 0, of) + loop
    backward = edge(0, 1, 1, 0, of) + edge(2, 1, -1, 0, of) + loop
    np.testing.assert_allclose(
        positions_of(tmp_path, backward, noise), positions_of(tmp_path, forward, noise), atol=1e-5
    )
    turned = edge(0, 1, 1, 0, sure) + edge(2, 1, 0, -1, sure, yaw=np.pi / 2)
    np.testing.assert_allclose(positions_of(tmp_path, turned, noise)[2], [2, 0, 0], atol=1e-3)


def test_a_step_that_nothing_measured_is_bridged_by_the_way_round_and_named(tmp_path: Path) -> None:
    of = information(*[1.0] * 6)
    text = edge(0, 1, 1, 0, of) + edge(4, 9, 1, 0, of) + edge(1, 9, 2, 0, of) + edge(0, 4, 2.5, 0, of)
    (tmp_path / "x.g2o").write_text(text)
    result = optimise_file(tmp_path / "x.g2o", tmp_path / "out", formulation=Formulation.BASE, solver=Solver.LM)
    assert [w for w in result["warnings"] if w.startswith("1 steps of robot robot-0 are not measured")]
    read = read_g2o(tmp_path / "out" / "optimised.g2o")
    assert list(read.vertices.values()) == [(0, 1, 4, 9)]  # the file's own numbers
    x = np.concatenate([read.T_initial[log][:, 0, 3] for log in read.T_initial])
    misfit = (1 + 2) - (2.5 + 1)
    np.testing.assert_allclose(x, [0, 1 - misfit / 4, 2.5 + misfit / 4, 3 - misfit / 2], atol=1e-5)


def test_a_closure_of_a_million_kilometres_is_refused_by_name_and_ends_no_solve(tmp_path: Path) -> None:
    of = information(*[1.0] * 6)
    text = edge(0, 1, 1, 0, of) + edge(1, 2, 1, 0, of) + edge(0, 2, 1e9, 0, of) + edge(0, 2, 2, 0, of)
    (tmp_path / "x.g2o").write_text(text)
    result = optimise_file(tmp_path / "x.g2o", tmp_path / "out", formulation=Formulation.BASE, solver=Solver.LM)
    (refused,) = result["closures_excluded"]
    assert "the measured length of 1e+09 m is longer" in refused["reason"]
    assert result["cost"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("fixed", [0, 2])
def test_the_result_lies_where_the_file_has_its_fixed_vertex(tmp_path: Path, fixed: int) -> None:
    of, quarter = information(*[1.0] * 6), np.pi / 2
    vertices = "".join(vertex(k, 10, 5 + k, quarter) for k in range(3))
    edges = edge(0, 1, 1, 0, of) + edge(1, 2, 1, 0, of) + edge(0, 2, 2, 0, of)
    found = positions_of(tmp_path, f"{vertices}FIX {fixed}\n{edges}")
    np.testing.assert_allclose(found, [[10, 5, 0], [10, 6, 0], [10, 7, 0]], atol=1e-6)


def test_what_is_not_read_is_counted_and_named(tmp_path: Path) -> None:
    (tmp_path / "x.g2o").write_text(f"{EDGE}\nEDGE_SE3_PRIOR 0 0 0 0\nEDGE_SE3_PRIOR 1 0 0 0\nVERTEX_XY 5 1 2\n")
    result = optimise_file(tmp_path / "x.g2o", tmp_path / "out")
    assert "2 lines of kind EDGE_SE3_PRIOR are left out" in result["warnings"]
    assert "1 lines of kind VERTEX_XY are left out" in result["warnings"]


@pytest.mark.parametrize("of", [information(*[0.0] * 6), information(1, 1, -1, 1, 1, 1)])
def test_information_that_is_not_positive_definite_is_refused_by_line(tmp_path: Path, of: str) -> None:
    (tmp_path / "x.g2o").write_text(EDGE + "\n" + edge(1, 2, 1, 0, of))
    with pytest.raises(GraphFileError, match="line 2: the information matrix is not positive definite"):
        read_g2o(tmp_path / "x.g2o")


def plane(first: int, second: int, x: float, yaw: float = 0.0, of: str = "1 0 0 1 0 1") -> str:
    return f"EDGE_SE2 {first} {second} {x!r} 0 {yaw!r} {of}\n"


RING = "".join(plane(k, (k + 1) % 4, 1.0 + 0.1 * (k == 3), np.pi / 2) for k in range(4))


def solved(tmp_path: Path, text: str | bytes, solver: Solver = Solver.LM) -> dict[str, Any]:
    (tmp_path / "x.g2o").write_bytes(text if isinstance(text, bytes) else text.encode())
    return optimise_file(tmp_path / "x.g2o", tmp_path / "out", formulation=Formulation.BASE, solver=solver)


@pytest.mark.parametrize("between", [(0, 1), (0, 2)])
def test_information_of_a_repeated_measurement_is_added_up_not_doubled(
    tmp_path: Path, between: tuple[int, int]
) -> None:
    first, second = between
    text = plane(0, 1, 1.0) + plane(1, 2, 1.0) + plane(0, 2, 2.3)
    line = next(line for line in text.splitlines() if line.startswith(f"EDGE_SE2 {first} {second} "))
    weaker = line.replace("1 0 0 1 0 1", "0.5 0 0 0.5 0 0.5") + "\n"
    sigma = {(0, 1): (1 / 1.5, 1.0, 1.0), (0, 2): (1.0, 1.0, 1 / 1.5)}[between]
    assert solved(tmp_path, text + weaker)["cost"] == pytest.approx(0.3**2 / sum(sigma), rel=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        b"\xef\xbb\xbf" + RING.encode(),
        RING.encode("utf-16"),
        b"# gr\xf6\xdfe\n" + RING.encode("latin-1"),
        b"% matlab\n// c\n" + RING.replace("\n", " # end\r\n").encode(),
        RING.replace("\n", "\r").encode(),
    ],
    ids=["mark", "utf-16", "latin comment", "comments", "old mac"],
)
def test_a_graph_is_read_whole_whatever_its_encoding_and_comments(tmp_path: Path, text: bytes) -> None:
    expected = solved(tmp_path, RING)
    found = solved(tmp_path, text)
    assert found["cost"] == expected["cost"]
    assert found["warnings"] == []


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (RING.replace("EDGE_SE2", "EDGE2"), "has no edges EDGE_SE3:QUAT or EDGE_SE2, but lines 4 of kind EDGE2"),
        (RING + "FIX abc\n", "line 5"),
        (RING + "FIX -1\n", "line 5: -1 is no key"),
        ("VERTEX_SE2 0 nan 0 0\n" + RING, r"line 1: a vertex has 3 finite numbers after its key, this one \[nan 0 0\]"),
        (plane(0, 1, 1e200) + RING, "the step of robot robot-0 from vertex 0 to 1 is 1e\\+200 m long"),
        (plane(0, 1, 1.0, of="1e300 0 0 1e300 0 1e300") + RING, "line 1: the information matrix has eigenvalues from"),
        (plane(0, 1, 1.0, of="1e12 0 0 1e-6 0 1") + RING, "line 1: the information matrix has eigenvalues from"),
        ("\0" + RING, "is not text"),
    ],
)
def test_what_would_be_lost_or_never_be_solved_is_refused_by_name(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(GraphFileError, match=complaint):
        solved(tmp_path, text)


@pytest.mark.parametrize("of", ["1e-15", "1e15"])
def test_a_planar_graph_may_have_any_unit(tmp_path: Path, of: str) -> None:
    text = RING + plane(0, 2, 1.0).replace("1 0 0 1 0 1", "1 0 0 1 0 1")
    usual, scaled = solved(tmp_path, text), solved(tmp_path, text.replace("1 0 0 1 0 1", f"{of} 0 0 {of} 0 {of}"))
    assert scaled["closures_excluded"] == []
    assert not [w for w in scaled["warnings"] if "not positive definite" in w]
    if float(of) > 1:
        assert scaled["cost"] == pytest.approx(usual["cost"] * float(of), rel=1e-3)
    else:
        assert [w for w in scaled["warnings"] if w.startswith("information is as small as 1e-15")]


def test_an_edge_that_is_far_stronger_than_the_others_is_named(tmp_path: Path) -> None:
    found = solved(tmp_path, RING.replace("1 0 0 1 0 1", "1e9 0 0 1e9 0 1e9", 1))
    assert [w for w in found["warnings"] if w.startswith("the edge from vertex 0 to 1 has over 1e+06 times")]


def test_vertices_without_edges_twice_or_fixed_are_named_and_cost_no_frame(tmp_path: Path) -> None:
    vertices = "".join(f"VERTEX_SE2 {key} {10 + k} 5 0\n" for k, key in enumerate([1, 5, 7, 9, 9]))
    edges = plane(1, 5, 1.0) + plane(5, 9, 1.0)
    found = solved(tmp_path, vertices + edges + "FIX 5 9 44\n")
    assert found["warnings"] == [
        "vertex 9: given more than once, the last pose counts",
        "vertex 7: no edge joins it, left out",
        "FIX 44: no vertex with an edge says where that is, nothing is held there",
        "FIX 5, 9: the first of them that is joined places the result, none holds it",
    ]
    (T,) = read_g2o(tmp_path / "out" / "optimised.g2o").T_initial.values()
    np.testing.assert_allclose(T[:, :3, 3], [[10, 5, 0], [11, 5, 0], [12, 5, 0]], atol=1e-6)


def key_of(robot: str, label: str, index: int) -> int:
    return (ord(robot) << 56) | ((ord(label) if label else 0) << 48) | index


def test_robots_of_labelled_symbols_are_told_apart(tmp_path: Path) -> None:
    one, other = ([key_of("x", label, k) for k in range(3)] for label in "AB")
    text = "".join(plane(a, b, 1.0) for keys in (one, other) for a, b in pairwise(keys))
    solved(tmp_path, text + plane(one[0], other[0], 2.0))
    assert set(read_g2o(tmp_path / "x.g2o").graph.trajectories) == {LogId("xa"), LogId("xb")}


def test_two_robots_whose_letters_differ_in_case_only_are_refused(tmp_path: Path) -> None:
    text = "".join(plane(key_of(robot, "", 0), key_of(robot, "", 1), 1.0) for robot in "aA")
    with pytest.raises(GraphFileError, match="are of two robots of which both are named a"):
        solved(tmp_path, text + plane(key_of("a", "", 0), key_of("A", "", 0), 1.0))


def test_what_was_left_out_is_said_without_json_too(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from flocc_launch.commands.offline import optimise

    (tmp_path / "x.g2o").write_text(RING + "".join(f"KIND_{k} 1\n" for k in range(12)))
    optimise(tmp_path / "x.g2o", tmp_path / "out")
    said = capfd.readouterr().err.splitlines()
    assert "warning: 1 lines of kind KIND_0 are left out" in said
    assert said[-1] == "warning: 2 more in result.json"


@pytest.mark.parametrize("text", ["a,b,c\n", "1\n2\n", "1,2,3\n1,2\n"])
def test_ground_truth_that_is_no_table_is_refused_by_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "0.g2o").write_text(plane(0, 1, 1.0))
    (tmp_path / "x_groundTruth.txt").write_text(text)
    with pytest.raises(GraphFileError, match=r"x_groundTruth\.txt: is no table x,y,theta"):
        read_g2o(tmp_path)
