"""A swarm that is watched: observers cost it next to nothing, and the doctor asks it why while it runs."""

import statistics
import threading
from pathlib import Path
from typing import Any

import pytest

from flocc_agent.config import AgentConfig
from flocc_lab.observers import LATENT_BYTES, watched, watched_scenario
from flocc_launch.dashboard.status_table import status_of_swarm
from flocc_launch.doctor import Finding
from flocc_launch.doctor.live import diagnose_live
from flocc_launch.scenarios.shipped import read_shipped
from flocc_launch.swarm.launching import Watch, launch

PERIOD_S = 0.5


@pytest.mark.swarm
@pytest.mark.scenarios
def test_a_dashboard_and_a_live_view_cost_next_to_nothing(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    seen = watched(watched_scenario(LATENT_BYTES), tmp_path / "run", observed=True)
    assert seen.report.map_frames == ["map/r1"]
    assert 0 < seen.observer_bytes <= 0.05 * seen.sent_bytes
    assert abs(statistics.median(seen.intervals_s) - PERIOD_S) < 0.05
    assert max(seen.intervals_s) < 3.0, "a robot that is silent for three seconds is out of range"
    drawn = (tmp_path / "run.rrd").read_bytes()
    for entity in (b"live/r1/odometry", b"corrected/r3", b"closures", b"follows r1"):
        assert entity in drawn, entity


@pytest.mark.swarm
@pytest.mark.scenarios
def test_the_doctor_asks_a_running_swarm_why_nothing_merges(tmp_path: Path) -> None:
    changes: dict[str, Any] = {"core.place_recognition.similarity_threshold": 0.9999, "duration_s": 14.0}
    found: list[Finding] = []

    def ask(config: Path) -> None:
        read = AgentConfig.read(config)
        found.extend(diagnose_live(status_of_swarm(read.transport, read.swarm)))

    asking: list[threading.Thread] = []

    def show(watch: Watch) -> None:
        told = [agent.said.keyframes > 10 and agent.said.leader for agent in watch.agents]
        if all(told) and not asking:
            asking.append(threading.Thread(target=ask, args=(watch.agents[0].folder / "config.json",)))
            asking[0].start()

    launch(read_shipped("corridor", changes), tmp_path / "run", show)
    asking[0].join()
    assert [finding.cause for finding in found] == ["low-similarity"], found
    assert "below the threshold of 0.9999" in found[0].sentence
