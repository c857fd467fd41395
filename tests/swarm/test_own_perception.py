"""A front end from outside of flocc, one file with an entry point, in a whole swarm of processes."""

import os
import shutil
from pathlib import Path

import pytest
from tests.agent.perception.plugin_folder import install

from flocc_agent.perception.backends import PerceptionError
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.swarm.launching import launch
from flocc_launch.world.generate import generate
from flocc_launch.world.spec import WorldSpec

EXAMPLE = Path(__file__).parents[2] / "examples/own_perception/orb_eyes.py"

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Rendered images of one street of a generated town; both robots play them."""
    spec = WorldSpec(width=320, height=240, route_m=15.0, image_rate_hz=2.0, robots=1)
    (path,) = generate(spec, tmp_path_factory.mktemp("world"))
    return {"r1": path, "r2": path}


def scenario(recordings: dict[str, Path], method: str) -> Scenario:
    robots = {name: {"recording": str(path)} for name, path in recordings.items()}
    fields = {"name": "own", "rate": 2.0, "settle_s": 4.0, "robots": robots, "perception": {"method": method}}
    return Scenario.model_validate(fields)


def test_a_front_end_of_ones_own_merges_maps_in_flocc_launch(
    recordings: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugin = tmp_path / "plugin"
    plugin.mkdir()
    shutil.copy(EXAMPLE, plugin)
    install(plugin, "orb", "orb_eyes:build")
    monkeypatch.syspath_prepend(plugin)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(plugin), os.environ.get("PYTHONPATH", "")]))
    report = launch(scenario(recordings, "orb"), tmp_path / "run")
    assert {robot.robot: robot.end for robot in report.robot_details} == {"r1": "stopped", "r2": "stopped"}
    assert report.map_frames == ["map/r1"]
    assert report.closures.accepted_inter_robot >= 3


def test_a_front_end_that_nobody_brings_is_named_before_anything_starts(
    recordings: dict[str, Path], tmp_path: Path
) -> None:
    with pytest.raises(PerceptionError, match="'sonar' is unknown"):
        launch(scenario(recordings, "sonar"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
