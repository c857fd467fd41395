"""Every form of calibration is read as it is or refused by name: drawn files, and the table in docs/data-sets.md."""

import re
from pathlib import Path

import numpy as np
import pytest

from flocc_lab.dialects.calibration_writers import FORMS, REFUSED
from flocc_lab.dialects.calibrations import campaign, judged
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.source import DatasetError

PAGE = Path(__file__).parents[2] / "docs" / "data-sets.md"


@pytest.mark.parametrize("name", FORMS)
def test_a_whole_file_of_each_form_gives_its_camera(name: str, tmp_path: Path) -> None:
    for seed in range(4):
        verdict = judged(name, None, np.random.default_rng(seed), tmp_path)
        assert verdict.outcome == "right", f"seed {seed}: {verdict}"


def test_drawn_files_are_right_or_refused(tmp_path: Path) -> None:
    bad = [verdict for verdict in campaign(50, 3, tmp_path) if not verdict.good]
    assert not bad, f"seed 3: {bad[0]}"


@pytest.mark.parametrize("name", REFUSED)
def test_other_forms_are_refused_with_what_to_do(name: str, tmp_path: Path) -> None:
    file, text = REFUSED[name]
    (tmp_path / file).write_text(text)
    with pytest.raises(DatasetError) as caught:
        read_lens(tmp_path / file, (640, 480))
    assert str(caught.value).startswith(f"{tmp_path / file}: ")
    assert re.search(r"flocc reads|give |convert|write|calibrate|export", str(caught.value)), str(caught.value)


def rows(heading: str) -> dict[str, list[str]]:
    """Cells of the table under a heading, by the first one."""
    text = PAGE.read_text(encoding="utf-8").split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in text.splitlines() if line.startswith("|")][2:]
    return {cells[0]: cells[1:] for line in lines if (cells := [cell.strip() for cell in line.strip("|").split("|")])}


def test_the_page_lists_every_form_with_its_file_and_models() -> None:
    told = rows("Calibrations")
    assert set(told) == {*FORMS, *REFUSED}
    for name, form in FORMS.items():
        models = "all" if len(form.kinds) == 6 else ", ".join(kind.value for kind in form.kinds)
        assert told[name] == [f"`{form.name}`", models, "yes" if form.mounting else "", "" if form.sized else "images"]
    for name, (file, _) in REFUSED.items():
        assert told[name][:2] == [f"`{file}`", "refused"]
