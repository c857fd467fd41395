"""`make swarm-test`: every shipped scenario over real zenoh, and its worse variant, which must end with exit code 1."""

import json
from pathlib import Path

import pytest
from tests.launch.test_cli import run
from tests.launch.worse_scenarios import WORSE, worse


def missed(folder: Path) -> set[str]:
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return {asked["name"] for asked in report["expectations"] if asked["met"] is not True}


@pytest.mark.swarm
@pytest.mark.scenarios
@pytest.mark.parametrize("name", WORSE)
def test_a_shipped_scenario_meets_what_it_expects(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = run(monkeypatch, "launch", name, "--out", str(tmp_path / "run"))
    assert (code, missed(tmp_path / "run")) == (0, set())


@pytest.mark.swarm
@pytest.mark.scenarios
@pytest.mark.parametrize("name", WORSE)
def test_a_worse_scenario_ends_with_exit_code_1(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = run(monkeypatch, "launch", str(worse(name, tmp_path)), "--out", str(tmp_path / "run"))
    assert (code, missed(tmp_path / "run")) == (1, set(WORSE[name].missed))
