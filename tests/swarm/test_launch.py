"""Whole swarms: one process per robot, real zenoh on loopback, synthetic perception."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from flocc_launch.report.model import RunReport
from flocc_launch.scenarios.scenario import Fault, FaultKind, Scenario
from flocc_launch.swarm.launching import Watch, launch

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def meeting(**changes: object) -> Scenario:
    """Three robots whose walks overlap, at four times the speed."""
    fields: dict[str, object] = {
        "name": "meeting",
        "rate": 4.0,
        "settle_s": 3.0,
        "tracks": {"robots": 3, "seed": 3, "area_m": 12.0, "length_m": 40.0},
        "perception": {"method": "synthetic"},
        **changes,
    }
    return Scenario.model_validate(fields)


def results(out: Path, report: RunReport) -> dict[str, dict[str, object]]:
    """What each robot knew at its end."""
    return {r: json.loads((out / "robots" / r / "result.json").read_text()) for r in report.robots}


def alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def test_three_processes_merge_and_leave_none_behind(tmp_path: Path) -> None:
    pids: set[int] = set()

    def watch(seen: Watch) -> None:
        pids.update(agent.process.pid for agent in seen.agents if agent.process)

    report = launch(meeting(), tmp_path / "run", watch)
    assert report.map_frames == ["map/r1"]
    assert report.closures.accepted_inter_robot >= 5
    assert report.ate_joint_m is not None
    assert report.ate_joint_m < 1.0
    assert len(pids) == 3
    assert [pid for pid in pids if alive(pid)] == []
    logs = [result["logs"] for result in results(tmp_path / "run", report).values()]
    assert logs[0] == logs[1] == logs[2]


def test_the_rest_elect_and_go_on_when_the_leader_is_killed(tmp_path: Path) -> None:
    kill = Fault(at_s=8.0, kind=FaultKind.KILL, robots=("r1",))
    report = launch(meeting(faults=[kill]), tmp_path / "run")
    leaders = [span.leader for span in report.leaders]  # r2 may lead until it hears r1, r3 while all are stopped
    assert leaders[leaders.index("r1") :][:2] == ["r1", "r2"]
    ends = {robot.robot: robot.end for robot in report.robot_details}
    assert ends == {"r1": "died", "r2": "stopped", "r3": "stopped"}
    known = results(tmp_path / "run", report)
    assert known["r2"]["logs"] == known["r3"]["logs"]
    assert known["r2"]["map_frame"] == known["r3"]["map_frame"] is not None  # map/r1 where r1 lived to be joined


def test_a_lossy_slow_radio_loses_nothing_for_ever(tmp_path: Path) -> None:
    report = launch(meeting(radio={"loss_ratio": 0.3, "latency_s": 0.1}), tmp_path / "run")
    assert report.map_frames == ["map/r1"]
    known = results(tmp_path / "run", report)
    assert known["r1"]["logs"] == known["r2"]["logs"] == known["r3"]["logs"]
    assert known["r1"]["closures"] is not None
    pairs = [[(c["query"], c["match"]) for c in result["closures"]] for result in known.values()]  # type: ignore[attr-defined]
    assert pairs[0] == pairs[1] == pairs[2]


def test_a_robot_comes_back_from_its_disk_with_its_numbering(tmp_path: Path) -> None:
    faults = [
        Fault(at_s=7.0, kind=FaultKind.KILL, robots=("r2",)),
        Fault(at_s=9.0, kind=FaultKind.RESTART, robots=("r2",)),
    ]
    report = launch(meeting(faults=faults), tmp_path / "run")
    known = results(tmp_path / "run", report)
    keyframes = known["r2"]["keyframes"]
    assert isinstance(keyframes, list)
    assert [keyframe["index"] for keyframe in keyframes] == list(range(len(keyframes)))
    assert known["r2"]["incarnation"] == 0
    assert known["r1"]["logs"] == known["r2"]["logs"]


def test_a_robot_that_is_killed_before_it_says_anything_is_no_failure_to_start(tmp_path: Path) -> None:
    faults = [
        Fault(at_s=0.1, kind=FaultKind.KILL, robots=("r2",)),
        Fault(at_s=0.5, kind=FaultKind.RESTART, robots=("r2",)),
    ]
    tracks = {"robots": 2, "seed": 3, "area_m": 6.0, "length_m": 10.0}
    report = launch(meeting(faults=faults, settle_s=1.0, tracks=tracks), tmp_path / "run")
    assert {robot.robot: robot.end for robot in report.robot_details} == {"r1": "stopped", "r2": "stopped"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP], ids=["ctrl-c", "closed terminal"])
def test_an_end_from_outside_stops_every_agent_in_order_and_still_reports(
    tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-m", "flocc_launch.commands.main", "launch", "meeting", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wait_until(lambda: any(out.glob("robots/*/events.jsonl")) and '"leader"' in events_of(out), 60.0)
    process.send_signal(number)
    text, _ = process.communicate(timeout=60.0)
    assert "Traceback" not in text
    report = json.loads((out / "report.json").read_text())
    assert [robot["end"] for robot in report["robot_details"]] == ["stopped"] * 3
    left = [path for path in Path("/proc").glob("[0-9]*/cmdline") if str(out).encode() in read_or_nothing(path)]
    assert left == []


def events_of(out: Path) -> str:
    return "".join(path.read_text() for path in out.glob("robots/*/events.jsonl"))


def read_or_nothing(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def wait_until(is_so: Callable[[], bool], timeout_s: float) -> None:
    """Look every 50 ms; fail when it does not become so in time."""
    end_s = time.monotonic() + timeout_s
    while not is_so():
        assert time.monotonic() < end_s, "it did not happen in time"
        time.sleep(0.05)
