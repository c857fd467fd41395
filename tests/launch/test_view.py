"""flocc view: a file for rerun's viewer, without a display."""

import builtins
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from tests.launch import synthetic_run

from flocc_launch.view import ViewError, view


def test_a_run_becomes_a_file_for_the_viewer(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "run.rrd"
    assert view(synthetic_run.write(tmp_path / "run"), out) == str(out)
    content = out.read_bytes()
    assert content[:4] in (b"RRF2", b"RRIO")
    for entity in (b"before/r1", b"after/closures", b"live/r2/odometry", b"error_m/r3", b"after/truth/r1"):
        assert entity in content, entity


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
    with pytest.raises(ViewError, match=r"flocc\[view\]"):
        view(folder, tmp_path / "run.rrd")
