"""`run.json` of a run folder, as a type."""

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from flocc_agent.runtime.robot_result import Record, RobotName

RUN_VERSION = 1


class Run(Record):
    """`run.json`: what was started."""

    version: int = RUN_VERSION
    """Version of this folder's layout."""
    scenario: str
    """Name of the scenario."""
    seed: int | None = None
    """Seed of everything that is drawn; null where nothing was seeded."""
    robots: list[RobotName]
    """Robot names."""
    servers: list[str] = Field(default_factory=list)
    """Those of them without a camera: they take no keyframes, so they are in no map."""
    start: str | float | None = None
    """Wall clock at t = 0: ISO 8601 or Unix seconds; null on virtual time."""
    driver: Literal["launch", "simulate", "agent"] | None = None
    """What ran the agents."""
    recordings: dict[str, str] = Field(default_factory=dict)
    """Robot -> folder of its recording; relative paths start at the run folder."""
    radio: dict[str, Any] = Field(default_factory=dict)
    """Settings of the link model: loss, latency, bandwidth, range, as the scenario gave them."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Other settings worth reading beside the result, nested as in the configuration."""
    perception: dict[str, Any] = Field(default_factory=dict)
    """What the robots saw with, as configured; empty in a run of an earlier version."""
    expectations: dict[str, float | str] = Field(default_factory=dict)
    """Expectation -> limit, of the scenario; of `leader` the robot's name."""
    duration_s: float | None = None
    """End of the run on the clock of `events.jsonl`; null where the last event is the end."""
    wall_s: float | None = None
    """Wall time that the run took; null where nobody measured it."""


def setting_number(settings: Mapping[str, Any], *names: str) -> float | None:
    """The number that stands under one of the names at any depth of nested settings; None where there is none."""
    for key, value in settings.items():
        if key in names and isinstance(value, int | float):
            return float(value)
        found = setting_number(value, *names) if isinstance(value, dict) else None
        if found is not None:
            return found
    return None
