"""Run folders that are given again: nothing that was recorded goes by a slip."""

import json
import logging
from pathlib import Path

import pytest

from flocc_agent.runtime.database import hold_lock
from flocc_launch.runs.run_folder import RunFolder, RunFolderError
from flocc_launch.swarm import fresh_folder as fresh


def held(path: Path, scenario: str | None) -> Path:
    """A run folder with a store in it; None: its run was killed before it said of what it is."""
    (path / "robots/r1").mkdir(parents=True)
    (path / "robots/r1/store").write_text("a mission")
    if scenario is not None:
        (path / "run.json").write_text(json.dumps({"scenario": scenario}))
    return path


def taken(path: Path) -> RunFolder:
    """The folder for a run of `town` that begins."""
    with fresh.fresh_folder(path, "town") as folder:
        assert folder.path == path
        (path / "run.json").write_text(json.dumps({"scenario": "town"}))
    return folder


def test_a_run_of_the_same_scenario_is_replaced(tmp_path: Path) -> None:
    taken(held(tmp_path / "run", "town"))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert list((tmp_path / "run/robots").iterdir()) == []


@pytest.mark.parametrize("earlier", ["field", None])
def test_any_other_run_is_kept_beside_it_and_said(
    tmp_path: Path, earlier: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        taken(held(tmp_path / "run", earlier))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.before"]
    assert (tmp_path / "run.before/robots/r1/store").read_text() == "a mission"
    assert list((tmp_path / "run/robots").iterdir()) == []
    assert f"held a run of {earlier or 'no known scenario'}, which is kept as {tmp_path / 'run.before'}" in caplog.text


@pytest.mark.parametrize("earlier", ["town", "field", None])
def test_a_start_that_fails_leaves_the_earlier_run_where_it_was_and_what_is_kept_of_others(
    tmp_path: Path, earlier: str | None
) -> None:
    held(tmp_path / "run", earlier)
    (held(tmp_path / "run.before", "yard") / "robots/r1/store").write_text("an older mission")
    for _ in range(2):
        with pytest.raises(FileExistsError), fresh.fresh_folder(tmp_path / "run", "town") as folder:
            (folder.path / "robots").mkdir()
    assert (tmp_path / "run/robots/r1/store").read_text() == "a mission"
    assert (tmp_path / "run.before/robots/r1/store").read_text() == "an older mission"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.before"]


@pytest.mark.parametrize("began", [False, True])
def test_a_driver_that_was_killed_lost_no_earlier_run(tmp_path: Path, began: bool) -> None:
    """What it leaves: the earlier run aside, and an empty folder or a run that began."""
    (held(tmp_path / "run.earlier", "yard") / "robots/r1/store").write_text("an older mission")
    run = tmp_path / "run"
    (run / "robots").mkdir(parents=True)
    (run / "lock").touch()
    if began:
        (run / "run.json").write_text(json.dumps({"scenario": "town"}))
    taken(run)
    assert (tmp_path / "run.before/robots/r1/store").read_text() == "an older mission"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.before"]


def test_empty_remains_put_nothing_out_of_its_place(tmp_path: Path) -> None:
    held(tmp_path / "run.before", "yard")
    (tmp_path / "run/robots/r1").mkdir(parents=True)
    taken(tmp_path / "run")
    assert (tmp_path / "run.before/robots/r1/store").read_text() == "a mission"


def test_what_is_no_run_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("three years")
    with pytest.raises(RunFolderError, match="is not empty and not an earlier run"):
        taken(tmp_path)


def test_a_folder_of_ones_own_that_has_robots_in_it_is_no_killed_run(tmp_path: Path) -> None:
    (held(tmp_path / "data", None) / "notes.txt").write_text("mine")
    with pytest.raises(RunFolderError, match="is not empty and not an earlier run"):
        taken(tmp_path / "data")
    assert (tmp_path / "data/robots/r1/store").read_text() == "a mission"


def test_what_stands_where_a_run_would_be_kept_is_not_deleted_unless_it_is_one(tmp_path: Path) -> None:
    run = held(tmp_path / "run", "field")
    (tmp_path / "run.before").mkdir()
    (tmp_path / "run.before/thesis.tex").write_text("three years")
    with pytest.raises(RunFolderError, match=r"run\.before is no run: choose another --out"):
        taken(run)
    assert (tmp_path / "run.before/thesis.tex").exists()
    assert (run / "robots/r1/store").exists()


def test_a_folder_in_which_a_run_is_going_on_is_refused_before_anything_in_it_is_touched(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with fresh.fresh_folder(run, "town"):
        (run / "robots/r1").mkdir()
        for scenario in ("town", "field"):
            with pytest.raises(RunFolderError, match="run: a run is going on in it"), fresh.fresh_folder(run, scenario):
                pass
        assert (run / "robots/r1").is_dir()
        assert [path.name for path in tmp_path.iterdir()] == ["run"]
    taken(run)
    assert not (run / "lock").exists()


def test_an_agent_that_outlived_its_launcher_keeps_its_folder(tmp_path: Path) -> None:
    run = tmp_path / "run"
    taken(run)
    agent = hold_lock(run / "robots/r1/store/lock")
    assert agent is not None
    with pytest.raises(RunFolderError, match="run: a run is going on in it"):
        taken(run)
    agent.close()
    taken(run)
    assert not (run / "robots/r1").exists()
