"""Experiments on the front ends that run out of the box: which data they take, and what their times are of."""

from pathlib import Path

import numpy as np
import pytest

from flocc_agent.config import PerceptionConfig
from flocc_lab.experiments import full_system
from flocc_lab.experiments.experiment import ExperimentError
from flocc_lab.experiments.full_system_data import METHODS, FullSystemSettings, scenario_of
from flocc_lab.experiments.registration_data import RegistrationSettings, make_scenes
from flocc_lab.experiments.split_compute import SIZE_PX, measured_times, procedural_images


def test_pictures_give_no_metric_closures_so_those_lines_are_left_out() -> None:
    cells = full_system.cells(FullSystemSettings(sources=("street", "herz_jesu")))
    assert {cell.parameters["source"] for cell in cells} == {"street", "herz_jesu"}
    assert not any(METHODS[cell.parameters["method"]].metric for cell in cells)


@pytest.mark.data
@pytest.mark.parametrize("source", ["street", "herz_jesu"])
def test_a_place_of_several_robots_is_a_swarm_with_the_chosen_front_end(shared: Path, source: str) -> None:
    learned = PerceptionConfig(method="learned")
    settings = FullSystemSettings(data=shared / "data", perception=learned)
    scenario = scenario_of(settings, source, METHODS["flocc smoothed lm"], seed=3)
    assert sorted(scenario.robots) == sorted(p.name for p in (shared / "data" / source).iterdir() if p.is_dir())
    assert scenario.perception.method == "learned"
    assert (scenario.backend.formulation.value, scenario.backend.solver.value) == ("smoothed", "lm")


@pytest.mark.data
def test_registration_takes_the_research_sets_that_are_asked_for(shared: Path) -> None:
    settings = RegistrationSettings(data=shared / "data", sets=("herz_jesu",), worlds=())
    assert list(make_scenes(settings)) == ["herz_jesu"]


def test_a_research_set_that_nobody_knows_is_named(tmp_path: Path) -> None:
    settings = RegistrationSettings(data=tmp_path, sets=("herz_jesu", "moon"), worlds=())
    with pytest.raises(ExperimentError, match=r"no research set 'moon'; there are sevenscenes, .*street, herz_jesu"):
        make_scenes(settings)


def test_features_are_timed_on_two_views_of_one_scene() -> None:
    first, second = procedural_images()
    assert first.pixels.shape == second.pixels.shape == (SIZE_PX[1], SIZE_PX[0], 3)
    assert not np.array_equal(first.pixels, second.pixels)
    times = measured_times("classical", rounds=1)
    assert set(times) == {"encode_s", "decode_s"}
    assert all(times[name] > 0.0 for name in times)
