"""Agents over zenoh in a saved map: found, in its frame, and what they add is its next edition."""

from pathlib import Path

import pytest
from tests.launch.map_missions import AGAIN, BLOCK, scenario

from flocc_agent.core.reports import FoundInMap
from flocc_agent.runtime.map_folder import MapFolder
from flocc_launch.maps.map_saving import save_map
from flocc_launch.maps.opening import MapUse
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Fault, FaultKind
from flocc_launch.swarm.launching import launch
from flocc_protocol.ids import LogId

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]


def test_a_launched_team_comes_back_to_its_map_also_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    launch(scenario(BLOCK, "monday", rate=3.0, settle_s=3.0), tmp_path / "monday")
    save_map(tmp_path / "monday", tmp_path / "map")
    faults = (
        Fault(at_s=12.0, kind=FaultKind.KILL, robots=("r1",)),
        Fault(at_s=13.0, kind=FaultKind.RESTART, robots=("r1",)),
    )
    again = scenario(AGAIN, "tuesday", settle_s=3.0, faults=faults)
    report = launch(again, tmp_path / "tuesday", use=MapUse(tmp_path / "map", fixed=True))
    assert (report.map_frames, report.maps_used) == (["map/r1"], [str(tmp_path / "map")])
    told = [each.fact for each in RunFolder.open(tmp_path / "tuesday").events()]
    found = [fact for fact in told if isinstance(fact, FoundInMap)]
    assert found
    assert found[0].keyframes <= 24
    manifest = save_map(tmp_path / "tuesday", tmp_path / "next")
    assert [entry.log for entry in manifest.logs] == ["r1", "r2", "r1~1"]
    old, new = MapFolder.open(tmp_path / "map").poses(), MapFolder.open(tmp_path / "next").poses()
    assert abs(new[LogId("r2")] - old[LogId("r2")]).max() < 1e-9
