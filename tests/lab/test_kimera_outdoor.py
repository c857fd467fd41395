"""Claims about reading dpgo_ros's measurements: what two robots list counts once, and the objective is truncated."""

from pathlib import Path

import numpy as np
import pytest

from flocc_agent.backend.problem import build
from flocc_agent.config import BackendConfig
from flocc_agent.geometry import pose
from flocc_lab.bench.kimera_outdoor import read, truncated

HEAD = "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau,is_known_inlier,weight\n"
SHARED = "0,1,1,1,0,0,0,1,0,5,0,10000,100,0,1\n"


def step(robot: int, first: int) -> str:
    return f"{robot},{first},{robot},{first + 1},0,0,0,1,1,0,0,10000,100,1,1\n"


def test_measurements_of_all_robots_are_one_graph(tmp_path: Path) -> None:
    for robot in (0, 1):
        folder = tmp_path / f"robot{robot}"
        folder.mkdir()
        lines = [step(robot, 0), step(robot, 1), SHARED]
        (folder / "measurements.csv").write_text(HEAD + "".join(lines), encoding="utf-8")
    graph = read(tmp_path)
    assert [len(t) for t in graph.trajectories.values()] == [3, 3]
    assert len(graph.closures) == 1, "both robots list it"
    problem = build(graph.trajectories, dict(enumerate(graph.closures)), BackendConfig(weight_by_probability=False))
    T = {
        log: np.array([pose(np.eye(3), np.array([k, 5.0 * n, 0.0])) for k in range(3)])
        for n, log in enumerate(problem.logs)
    }
    assert truncated(problem, T, 0.99) == pytest.approx(0.0, abs=1e-9)
    T[problem.logs[1]][:, 1, 3] += 0.1
    assert truncated(problem, T, 0.99) == pytest.approx(1.0), "one standard deviation: tau is information"
    T[problem.logs[1]][:, 1, 3] += 100.0
    assert truncated(problem, T, 0.99) == pytest.approx(16.81, abs=0.01)


def test_a_folder_without_measurements_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no robot"):
        read(tmp_path)
