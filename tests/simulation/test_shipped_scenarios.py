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
def test_a_shipped_scenario_meets_what_it_expects(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(monkeypatch, "simulate", name, "--out", str(tmp_path / "run")) == 0
    assert missed(tmp_path / "run") == set()


@pytest.mark.parametrize("name", WORSE)
def test_a_worse_scenario_ends_with_exit_code_1(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = worse(name, tmp_path)
    assert run(monkeypatch, "simulate", str(path), "--out", str(tmp_path / "run")) == 1
    assert missed(tmp_path / "run") == WORSE[name].missed


def test_a_shipped_scenario_is_the_same_run_every_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for copy in ("first", "second"):
        assert run(monkeypatch, "simulate", "corridor", "--out", str(tmp_path / copy)) == 0
    events = [(tmp_path / copy / "events.jsonl").read_bytes() for copy in ("first", "second")]
    assert events[0] == events[1]
