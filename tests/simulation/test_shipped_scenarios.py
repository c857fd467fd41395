"""Every shipped scenario meets its expectations on virtual time, and misses them when something is made worse."""

import json
from pathlib import Path

import pytest
from tests.launch.test_cli import run
from tests.launch.worse_scenarios import WORSE, worse

from flocc_launch.scenarios.shipped import names


def missed(folder: Path) -> set[str]:
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return {asked["name"] for asked in report["expectations"] if asked["met"] is not True}


def test_every_shipped_scenario_has_a_worse_variant() -> None:
    assert set(names()) == {*WORSE, "demo"}, "demo renders a world: `make demo` runs it"


@pytest.mark.parametrize("name", WORSE)
def test_a_shipped_scenario_meets_what_it_expects_the_same_every_time(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copies = ("first", "second") if name == "corridor" else ("first",)
    for copy in copies:
        assert run(monkeypatch, "simulate", name, "--out", str(tmp_path / copy)) == 0
    assert missed(tmp_path / "first") == set()
    assert len({(tmp_path / copy / "events.jsonl").read_bytes() for copy in copies}) == 1


@pytest.mark.parametrize("name", WORSE)
def test_a_worse_scenario_ends_with_exit_code_1(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = worse(name, tmp_path)
    assert run(monkeypatch, "simulate", str(path), "--out", str(tmp_path / "run")) == 1
    assert missed(tmp_path / "run") == WORSE[name].missed
