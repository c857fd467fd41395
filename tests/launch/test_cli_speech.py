"""How much the command line says, and in which form: --json, --quiet, --verbose."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from tests.doc_props import write_own_data
from tests.launch import synthetic_run
from tests.launch.test_cli_help import said

from flocc_launch.commands.main import app, main
from flocc_launch.report.finish import finish

NO_FACTS = {
    "agent": "runs until it is stopped; its facts are in its folder",
    "dashboard": "serves a page",
    "view": "opens a viewer",
    "dataset convert": "writes a recording",
    "dataset split": "writes recordings",
    "dataset team": "writes recordings",
    "dataset graph": "writes recordings",
    "weights get": "brings files",
    "weights fetch": "brings a file",
    "weights synthesize": "writes files",
    "experiment": "writes tables and findings",
    "export": "writes a file",
    "map save": "writes a map",
    "map merge": "writes a map",
    "map prune": "writes a map",
    "map sessions": "writes maps",
    "map export": "writes files",
}


def commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, set[str]]]:
    """Every command by its words, with its options; the lab's groups count as one."""
    inside = getattr(command, "commands", None)
    if not inside or path in {("bench",), ("experiment",)}:
        yield " ".join(path), {option for parameter in command.params for option in parameter.opts}
        return
    for name, child in inside.items():
        yield from commands(child, (*path, name))


def test_every_command_that_prints_facts_prints_them_as_json() -> None:
    known = dict(commands(typer.main.get_command(app)))
    without = {name for name, options in known.items() if "--json" not in options}
    assert without - {"bench"} == set(NO_FACTS), (
        "a new command prints its facts with --json, or says here why it has none"
    )


def ran(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str, code: int = 0
) -> tuple[str, str]:
    """What `flocc WORDS` prints to stdout and to stderr."""
    monkeypatch.setattr("sys.argv", ["flocc", *words])
    try:
        main()
        left = 0
    except SystemExit as leaving:
        left = int(leaving.code or 0)
    out, err = capsys.readouterr()
    assert left == code, err
    return out, err


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = synthetic_run.write(tmp_path / "run")
    finish(folder)
    return folder.path


SCENARIO = """
name = "two"
seed = 1
[tracks]
robots = 2
length_m = 12
[perception]
method = "synthetic"
"""


def test_a_simulation_says_json_and_nothing_else_on_stdout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    (tmp_path / "two.toml").write_text(SCENARIO)
    out, err = ran(
        monkeypatch, capsys, "simulate", str(tmp_path / "two.toml"), "--json", "--out", str(tmp_path / "run")
    )
    assert json.loads(out)["robots"] == ["r1", "r2"]
    assert json.loads(out) == json.loads((tmp_path / "run/report.json").read_text())
    assert err.startswith("report: ")


def test_quiet_says_the_verdict_and_verbose_the_accounts(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    usual, _ = ran(monkeypatch, capsys, "evaluate", str(run))
    quiet, _ = ran(monkeypatch, capsys, "evaluate", str(run), "--quiet")
    verbose, _ = ran(monkeypatch, capsys, "evaluate", str(run), "-v")
    verdict = "All three robots found one common map after 41.3 s."
    assert quiet.startswith(verdict)
    assert len(quiet.splitlines()) == 2
    assert quiet.splitlines()[1].startswith("report: ")
    assert len(usual.splitlines()) > 10
    assert ("latents" in usual, "latents" in verbose) == (False, True)


def test_quiet_and_verbose_contradict_each_other(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text = said(monkeypatch, capsys, "evaluate", str(run), "-q", "-v")
    assert (code, "--quiet and --verbose contradict each other" in text) == (2, True)


FACTS = [("weights", "status"), ("dataset", "info", "DATA"), ("evaluate", "RUN"), ("status", "RUN")]


@pytest.mark.parametrize("words", FACTS, ids=" ".join)
def test_facts_are_json(
    words: tuple[str, ...],
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = str(write_own_data(tmp_path / "my_data")) if "DATA" in words else ""
    places = {"DATA": data, "RUN": str(run)}
    out, _ = ran(monkeypatch, capsys, *(places.get(word, word) for word in words), "--json")
    told = json.loads(out)
    assert told
    if "DATA" in words:
        assert (told[0]["images"], told[0]["camera"]["width"]) == (42, 320)
