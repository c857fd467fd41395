"""`backend.mode = "distributed"` in whole agents on virtual time: one map without a leader's rounds."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend.consensus_pair import PairedRobot, Tidings
from flocc_agent.config import BackendConfig, BackendMode, Formulation
from flocc_launch.doctor import diagnose
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import simulate

Float = NDArray[np.float64]


def scenario(**changes: Any) -> Scenario:
    """Three robots whose walks overlap; their registrations are metric."""
    exact = {"scale_sigma_ratio": 0.0, "scale_drift_sigma_ratio": 0.0}
    fields: dict[str, Any] = {
        "name": "together",
        "tracks": {"robots": 3, "seed": 1, "area_m": 12.0, "length_m": 20.0},
        "keyframes": {"distance_m": 1.0},
        "perception": {"method": "synthetic", "synthetic": exact},
        "backend": {"mode": "distributed", "formulation": "base"},
        "radio": {"loss_ratio": 0.3, "latency_s": 0.05, "jitter_s": 0.05},
    }
    return Scenario.model_validate({**fields, **changes})


def test_robots_that_lose_messages_agree_on_one_map_that_no_leader_made(tmp_path: Path) -> None:
    report = simulate(scenario(), tmp_path / "run", 1)
    assert report.map_frames == ["map/r1"]
    assert report.ate_joint_m is not None
    assert report.bytes["shared-poses"] > 0
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert not {line["event"] for line in lines} & {"optimised", "peer_refused"}
    givers = {(line["robot"], line["leader"]) for line in lines if line["event"] == "correction"}
    assert givers == {("r1", "r1"), ("r2", "r2"), ("r3", "r3")}
    central = simulate(scenario(backend={"formulation": "base"}), tmp_path / "central", 1)
    assert central.ate_joint_m is not None
    assert report.ate_joint_m < 1.2 * central.ate_joint_m + 0.02


def test_a_robot_that_was_killed_comes_back_above_its_last_step(tmp_path: Path) -> None:
    faults = [
        {"at_s": 18.0, "kind": "kill", "robots": ["r2"]},
        {"at_s": 22.0, "kind": "restart", "robots": ["r2"]},
    ]
    report = simulate(scenario(faults=faults), tmp_path / "run", 1)
    assert report.map_frames == ["map/r1"]
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    rounds = [line["round"] for line in lines if line["event"] == "correction" and line["robot"] == "r2"]
    assert rounds == sorted(set(rounds))


FARTHEST_M = 15.0
"""Twice the side of the crowd's area: no correction moves a robot out of it."""
CROWD = {
    "tracks": {"robots": 4, "seed": 102, "area_m": 8.0, "length_m": 12.0},
    "keyframes": {"distance_m": 1.5},
    "radio": {"latency_s": 0.05, "jitter_s": 0.05},
}


hear = PairedRobot.hear


def heard_by_the_penalty_of_before(pair: PairedRobot, told: Tidings, here: Float) -> None:
    """As if the higher robot went on by the penalty that it had, while it says that it has the new one."""
    before = pair.penalty
    hear(pair, told, here)
    pair.penalty = before


@pytest.mark.parametrize("differ", [False, True])
def test_robots_whose_penalties_differ_come_apart_and_notice_it_and_none_corrects_itself_by_that(
    differ: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robots that nothing else holds are nearly free here, so that there is far to go; still they agree, else not."""
    if differ:
        monkeypatch.setattr(PairedRobot, "hear", heard_by_the_penalty_of_before)
    simulate(scenario(**CROWD), tmp_path / "run", 1)
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    apart = {(line["robot"], line["peer"]) for line in lines if line["event"] == "peer_refused"}
    causes = {finding.cause for finding in diagnose(RunFolder(tmp_path / "run"))}
    assert bool(apart) == ("came-apart" in causes) == differ
    corrected_m = [np.linalg.norm(line["T_map_odom"][:3]) for line in lines if line["event"] == "correction"]
    assert max(corrected_m) < FARTHEST_M


def test_what_distributed_mode_cannot_do_is_refused_with_a_sentence() -> None:
    with pytest.raises(ValueError, match="no scale that all robots share"):
        BackendConfig(mode=BackendMode.DISTRIBUTED, formulation=Formulation.SHARED)
