"""The dashboard of a launch: a browser sees the new leader while the swarm goes on after its leader was killed."""

import re
from pathlib import Path

import pytest
from tests.launch.test_dashboard import browse, rows

from flocc_launch.dashboard import live_dashboard
from flocc_launch.doctor.installation import free_port
from flocc_launch.launching import Watch, launch
from flocc_launch.run_folder import RunFolder
from flocc_launch.shipped import read_shipped

KILL_S = 8.0
LOOK_S = 14.0


@pytest.mark.swarm
@pytest.mark.slow
def test_a_browser_sees_the_new_leader_of_a_swarm_whose_leader_was_killed(tmp_path: Path) -> None:
    faults = [{"at_s": KILL_S, "kind": "kill", "robots": ["r1"]}]
    scenario = read_shipped("meeting", {"faults": faults, "duration_s": LOOK_S + 2.0})
    port, seen = free_port(), list[str]()

    def look(watch: Watch) -> None:
        if watch.elapsed_s >= LOOK_S and not seen:
            seen.append(browse(f"http://127.0.0.1:{port}/", tmp_path / "profile"))

    with live_dashboard(RunFolder(tmp_path / "run"), port, look) as show:
        launch(scenario, tmp_path / "run", show)
    (html,) = seen
    found = rows(html)
    assert sorted(found) == ["r1", "r2", "r3"]
    assert (found["r2"]["leader"], found["r3"]["leader"]) == ("r2", "r2")
    assert "no longer hears r1" in re.sub(r"<[^>]+>", " ", html)
    assert found["r2"]["frame"].startswith("map/")
