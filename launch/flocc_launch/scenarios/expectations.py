"""Whether a scenario's expectations can be measured at all: asked before a run, so that none is run for nothing."""

from collections.abc import Mapping
from pathlib import Path

from flocc_launch.scenarios.scenario import Scenario
from flocc_protocol.errors import FloccError

OF_GROUND_TRUTH = ("ate_max_m", "ate_ratio_max")
OF_TWO_ROBOTS = ("merged_within_s", "closures_min", "leader_registered_ratio_min")


class ExpectationError(FloccError):
    """An expectation that no run of its scenario could meet or miss; one sentence names it."""


def check_measurable(scenario: Scenario, recordings: Mapping[str, Path]) -> None:
    """Say which expectation cannot be measured.

    Args:
        scenario: What is to run.
        recordings: Robots' recordings, where its data was made into some.

    Raises:
        ExpectationError: An error against ground truth is expected of a robot without, or a merge of one robot alone.
    """
    asked = scenario.expectations.limits()
    given = {name: recordings.get(name) or scenario.robot(name).recording for name in scenario.names()}
    untrue = [name for name, path in given.items() if path is not None and not (path / "groundtruth.tum").exists()]
    for name in OF_GROUND_TRUTH:
        if name in asked and untrue:
            where = given[untrue[0]]
            raise ExpectationError(f"expectations.{name} cannot be measured: {where} has no groundtruth.tum")
    moving = len(scenario.names()) - len(scenario.servers())
    for name in OF_TWO_ROBOTS:
        if name in asked and moving < 2:
            raise ExpectationError(f"expectations.{name} cannot be measured: it takes two robots with a camera")
