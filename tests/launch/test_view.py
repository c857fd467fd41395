"""flocc view: a file for rerun's viewer, without a display."""

import builtins
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.launch import synthetic_run
from tests.launch.test_dashboard import growing, kill_the_leader, start_swarm

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.robot_result import ClosureKnown
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.shipped import read_shipped
from flocc_launch.simulation.simulate import simulate
from flocc_launch.view.live_view import view_growing
from flocc_launch.view.run_view import ViewError, closed, left_over, residuals, view

ENTITIES = (
    b"before/r1",
    b"after/closures",
    b"live/r2/odometry",
    b"live/r2/here",
    b"error_m/r3",
    b"after/truth/r1",
    b"links",
    b"closures",
    b"closure/probability",
    b"solver/cost",
    b"solver/closures_used",
)


def test_a_run_becomes_a_file_for_the_viewer(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "run.rrd"
    assert view(synthetic_run.write(tmp_path / "run"), out) == str(out)
    content = out.read_bytes()
    assert content[:4] in (b"RRF2", b"RRIO")
    for entity in ENTITIES:
        assert entity in content, entity


def test_a_simulated_run_shows_what_is_left_of_its_closures_and_their_images(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    scenario = read_shipped("corridor")
    simulate(scenario, tmp_path / "run", recordings=recordings(scenario))
    folder = RunFolder.open(tmp_path / "run")
    view(folder, tmp_path / "run.rrd")
    content = (tmp_path / "run.rrd").read_bytes()
    for entity in (b"residual/translation_m", b"residual/rotation_rad", b"closure/query", b"closure/match"):
        assert entity in content, entity
    assert np.median([metres for metres, _ in residuals(load(folder)).values()]) < 0.5


def test_a_run_that_goes_on_is_drawn_as_it_grows(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    folder = growing(tmp_path / "run")
    looks = iter(range(4))

    def is_over() -> bool:
        look = next(looks)
        if look == 1:
            start_swarm(folder)
        if look == 2:
            kill_the_leader(folder)
        return look == 3

    view_growing(folder, tmp_path / "run.rrd", is_over)
    content = (tmp_path / "run.rrd").read_bytes()
    for entity in (b"live/r3/odometry", b"live/r2/here", b"links", b"lost its leader"):
        assert entity in content, entity


def test_a_file_that_a_full_disk_cut_off_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    recording = SimpleNamespace(flush=lambda: None)
    with pytest.raises(ViewError, match="the disk is full, and the file is cut off"):
        closed(recording, tmp_path / "run.rrd", "shown")
    assert closed(recording, None, "shown") == "shown"

    def fail() -> None:
        raise RuntimeError("File too large")

    with pytest.raises(ViewError, match=r"run.rrd: cannot be written \(File too large\)"):
        closed(SimpleNamespace(flush=fail), tmp_path / "run.rrd", "shown")


def test_no_display_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    for key in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(key, raising=False)
    with pytest.raises(ViewError, match=r"there is no display to open the viewer on; write a file with --save"):
        view(synthetic_run.write(tmp_path / "run"))


def test_what_is_left_of_a_closure_is_measured_between_its_cameras() -> None:
    closure = ClosureKnown(
        query="r1/0", match="r2/0", T_query_match_unscaled=[0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], scale=2.0
    )
    apart = pose(so3_exp(np.array([0.0, 0.0, 0.1])), np.array([1.0, 0.3, 0.0]))
    metres, radians = left_over(closure, apart)
    assert (round(metres, 9), round(radians, 9)) == (0.3, 0.1)


def test_rerun_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    imported = builtins.__import__

    def without_rerun(
        name: str,
        globals: Mapping[str, object] | None = None,
        locals: Mapping[str, object] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> Any:
        if name == "rerun":
            raise ImportError(name)
        return imported(name, globals, locals, fromlist, level)

    monkeypatch.setattr(builtins, "__import__", without_rerun)
    with pytest.raises(ViewError, match=r"\.\[view\]"):
        view(folder, tmp_path / "run.rrd")
