"""Everything in examples/ runs, as its first lines say. Live ones: tests/swarm."""

import asyncio
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from tests.doc_props import FOCAL, HEIGHT, IMAGES, WIDTH, photographs, walk
from tests.launch.bag_fixtures import BagScript

from flocc_agent import AgentConfig
from flocc_agent.geometry import tq_from_pose
from flocc_launch.report import read_report
from flocc_launch.runs.run_folder import RunFolder

EXAMPLES = Path(__file__).parents[2] / "examples"
RUN_ELSEWHERE = {
    "robot_program.py": "docs/python-api.md, by tests/test_docs.py",
    "saved_map.py": "docs/maps.md, by tests/test_docs.py",
    "independent_peer.py": "tests/swarm/test_independent_peer.py",
    "own_perception": "tests/swarm/test_own_perception.py",
    "ros2": "tests/agent/runtime/ros2/test_ros2_node.py, as far as it goes without ROS",
}


def in_examples(*words: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    given = {**os.environ, "PATH": path, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run(words, cwd=folder, env=given, capture_output=True, text=True, check=False, timeout=240)


def walked_bag(path: Path) -> None:
    """What a robot saw that walked once along two painted walls, with its odometry; the camera is the body."""
    script = BagScript(True)
    stamps_s, poses = (walked[:IMAGES] for walked in walk())
    for stamp_s, T, pixels in zip(stamps_s, poses, photographs(poses), strict=True):
        stamp_ns = round(1e9 * stamp_s)
        x, y, z, qw, qx, qy, qz = (float(value) for value in tq_from_pose(T))
        script.odometry("/odom", stamp_ns, x, (qx, qy, qz, qw))
        odometry = script.messages[-1][3]
        odometry.pose.pose.position.y, odometry.pose.pose.position.z = y, z
        script.jpeg("/camera/image_raw", stamp_ns, cv2.imencode(".jpg", pixels)[1].tobytes())
    script.camera_info("/camera/camera_info", round(1e9 * stamps_s[0]), FOCAL)
    info = script.messages[-1][3]
    info.width, info.height, info.D = WIDTH, HEIGHT, np.zeros(5)
    info.K = np.array([FOCAL, 0, WIDTH / 2, 0, FOCAL, HEIGHT / 2, 0, 0, 1])
    script.write(path)


def test_every_example_is_run_and_stands_on_the_page() -> None:
    source = Path(__file__).read_text(encoding="utf-8")
    page = (EXAMPLES.parent / "docs/examples.md").read_text(encoding="utf-8")
    there = {path.name for path in EXAMPLES.iterdir() if path.name != "__pycache__"}
    assert {name for name in there if name not in RUN_ELSEWHERE and f'EXAMPLES / "{name}"' not in source} == set()
    assert {name for name in there if f"../examples/{name}" not in page} == set()


@pytest.mark.slow
def test_a_scenario_runs_in_a_test_suite_of_ones_own(tmp_path: Path) -> None:
    suite = shutil.copytree(EXAMPLES / "scenario_in_pytest", tmp_path / "suite")
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", str(suite))
    ran = in_examples(*command, folder=tmp_path, FLOCC_CACHE=str(tmp_path / "cache"))
    assert ran.returncode == 0, ran.stdout[-3000:]
    assert "3 passed" in ran.stdout


@pytest.mark.slow
def test_a_teams_bags_become_one_report(tmp_path: Path) -> None:
    (tmp_path / "bags").mkdir()
    walked_bag(tmp_path / "bags/rover.bag")
    shutil.copyfile(tmp_path / "bags/rover.bag", tmp_path / "bags/drone.bag")
    script = EXAMPLES / "team_from_bags.sh"
    ran = in_examples("sh", str(script), "bags", "out", folder=tmp_path, FLOCC_CACHE=str(tmp_path / "cache"))
    assert ran.returncode == 0, f"{ran.stdout[-2000:]}\n{ran.stderr[-2000:]}"
    assert RunFolder.open(tmp_path / "out").run().robots == ["drone", "rover"]
    assert (tmp_path / "out/report.html").exists()
    assert re.search(r"^ok +All 2 robots", ran.stdout, re.M), ran.stdout


@pytest.mark.slow
def test_a_map_is_saved_and_opened_again(tmp_path: Path) -> None:
    script = EXAMPLES / "saved_map.sh"
    ran = in_examples("sh", str(script), "out", folder=tmp_path, FLOCC_CACHE=str(tmp_path / "cache"))
    assert ran.returncode == 0, f"{ran.stdout[-2000:]}\n{ran.stderr[-2000:]}"
    monday, tuesday = (read_report(tmp_path / "out" / day / "report.json") for day in ("monday", "tuesday"))
    assert tuesday.map_frames == monday.map_frames
    assert re.search(r"^ok +All \d robots", ran.stdout, re.M), ran.stdout


def robot_program() -> Any:
    spec = importlib.util.spec_from_file_location("robot_program", EXAMPLES / "robot_program.py")
    assert spec is not None
    assert spec.loader is not None
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    return program


async def test_two_robots_programs_can_find_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """A swarm without a name looks for nobody."""
    program, made = robot_program(), []

    class Stopped(Exception):
        pass

    def agent(config: AgentConfig, *_: object) -> None:
        made.append(config)
        raise Stopped

    monkeypatch.setattr(program, "Agent", agent)
    monkeypatch.setattr(program.Recording, "open", lambda _: SimpleNamespace(camera=None, T_body_camera=None))
    monkeypatch.setattr(sys, "argv", ["robot_program.py", "--name", "r1", "recording"])
    with pytest.raises(Stopped):
        await program.main()
    assert made[0].transport.scouts(made[0].swarm)


async def test_a_robots_program_says_that_it_waits(capsys: pytest.CaptureFixture[str]) -> None:
    """Silence would be taken for a fault."""
    program = robot_program()
    status = SimpleNamespace(round=None, keyframes=7, neighbours=("r2",))
    saying = asyncio.create_task(program.print_waiting(SimpleNamespace(status=lambda: status), period_s=0.01))
    await asyncio.sleep(0.05)
    first = capsys.readouterr().out
    status.round = 1
    await asyncio.sleep(0.03)
    capsys.readouterr()
    await asyncio.sleep(0.03)
    saying.cancel()
    assert first.splitlines()[0] == "no correction yet: 7 keyframes, 1 neighbours"
    assert capsys.readouterr().out == ""
