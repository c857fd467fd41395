"""docs/scenarios.md: its tables are the models', its examples the shipped files, and its own scenario can be read."""

import re
import tomllib
from pathlib import Path

from flocc_lab.reference.scenario_page import filled
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.shipped import names

PAGE = Path(__file__).parents[2] / "docs" / "scenarios.md"


def test_the_generated_parts_are_those_of_the_models() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert filled(page) == page, "run: python -m flocc_lab.reference.scenario_page docs/scenarios.md"


def test_every_scenario_on_the_page_can_be_used() -> None:
    blocks = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    found = {Scenario.model_validate(tomllib.loads(block)).name for block in blocks}
    assert found == {"hangar", *names()} - {"demo"}


def test_every_key_of_a_scenario_is_on_the_page() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for key in (
        "`expectations.leader`",
        "`tracks.routes_m`",
        "`rendezvous.from_s`",
        "`faults.at_s`",
        "`simulation.encode_s`",
    ):
        assert key in page, key
