"""Robots that come later into a saved map: when they are in it, and the map beside one of all at once."""

from pathlib import Path

from tests.launch.map_missions import BLOCK, FAR, scenario

from flocc_lab.bench.later_robots import Arrival, Later, measure
from flocc_launch.scenarios.recordings import recordings


def test_a_robot_that_walks_the_mapped_block_finds_itself(tmp_path: Path) -> None:
    given = scenario(BLOCK)
    later = measure(given, recordings(given), ["r1"], tmp_path)
    (arrival,) = later.arrivals
    assert (arrival.robot, arrival.near) == ("r2", 0)
    assert arrival.found is not None
    assert later.ate_m is not None
    assert later.verdict()["met"]


def test_a_robot_that_walks_elsewhere_need_not_be_found_but_gives_no_map_of_all(tmp_path: Path) -> None:
    given = scenario({"r1": BLOCK["r1"], "r2": FAR["r2"]})
    later = measure(given, recordings(given), ["r1"], tmp_path)
    (arrival,) = later.arrivals
    assert (arrival.near, arrival.found, arrival.in_time) == (None, None, True)
    assert later == Later(later.arrivals, None, None)
    assert not later.verdict()["met"]


def test_what_is_asked_for() -> None:
    def met(found: int | None, ate_m: float) -> object:
        return Later((Arrival("r3", 90, 10, found),), ate_m, 0.5).verdict()["met"]

    assert [met(30, 0.75), met(31, 0.5), met(None, 0.5), met(11, 0.76)] == [True, False, False, False]
