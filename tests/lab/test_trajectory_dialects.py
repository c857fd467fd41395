"""Every form of trajectory, name and folder is read as it is or refused: drawn files, and the tables of the page."""

from pathlib import Path

import numpy as np
import pytest
from tests.lab.test_calibration_dialects import rows

from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_lab.dialects.folder_writers import COUNT, FOLDERS, drawn
from flocc_lab.dialects.trajectories import campaign
from flocc_lab.dialects.trajectory_writers import AMBIGUOUS_NAMES, FORMS, NAMES, NUMBERS, REFUSED, rows_of
from flocc_launch.datasets.commands import convert, info
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.other_kinds import FILES
from flocc_launch.datasets.other_kinds import FOLDERS as OTHER_FOLDERS
from flocc_launch.datasets.source import DatasetError


def test_drawn_files_are_right_or_refused(tmp_path: Path) -> None:
    bad = [verdict for verdict in campaign(50, 3, tmp_path) if not verdict.good]
    assert not bad, f"seed 3: {bad[0]}"


@pytest.mark.parametrize("name", FORMS)
def test_a_form_gives_its_trajectory(name: str, tmp_path: Path) -> None:
    truth = drawn()
    start = truth.relative_to_first() if FORMS[name].how == "motion" else truth
    (tmp_path / FORMS[name].file).write_text(FORMS[name].write(rows_of(start)))
    found, _ = read_trajectory(tmp_path / FORMS[name].file)
    np.testing.assert_allclose(found.stamps_s, start.stamps_s, atol=1e-6)
    np.testing.assert_allclose(found.T_fixed_body, start.T_fixed_body, atol=1e-6)


@pytest.mark.parametrize("name", REFUSED)
def test_other_forms_are_refused_with_what_to_do(name: str, tmp_path: Path) -> None:
    file, text = REFUSED[name]
    (tmp_path / file).write_text(text)
    with pytest.raises(RecordingError) as caught:
        read_trajectory(tmp_path / file)
    assert str(caught.value).startswith(f"{tmp_path / file}")


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_gives_its_images_and_poses(name: str, tmp_path: Path) -> None:
    form = FOLDERS[name]
    source = read_source(form.write(tmp_path / "d"))
    found = source.odometry if form.is_odometry else source.truth
    assert (source.format, len(source.images)) == (form.reader, COUNT)
    assert found is not None
    np.testing.assert_allclose(found.T_fixed_body, drawn().T_fixed_body, atol=1e-6)
    assert source.lens is not None
    if form.reader != "7scenes":
        assert (source.lens.camera.fx, source.lens.camera.cx) == (30.0, 16.0)
    assert [found.at(stamp_s) is not None for stamp_s, _ in source.images] == [True] * COUNT


@pytest.mark.parametrize("form", OTHER_FOLDERS, ids=lambda form: form[0])
def test_other_folders_are_refused_by_name(form: tuple[str, tuple[str, ...], str], tmp_path: Path) -> None:
    for marker in form[1]:
        (tmp_path / "d" / marker).mkdir(parents=True)
    with pytest.raises(DatasetError, match=f"is {form[0]}, which flocc does not read; "):
        read_source(tmp_path / "d")


@pytest.mark.parametrize("suffix", FILES)
def test_other_files_are_refused_by_name(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"data{suffix}").write_bytes(b"\0\1\2")
    for command in (info, lambda path: convert(path, tmp_path / "out")):
        with pytest.raises(DatasetError, match=f"is {FILES[suffix][0]}, which flocc does not read; {FILES[suffix][1]}"):
            command(tmp_path / f"data{suffix}")


def test_the_page_lists_every_form() -> None:
    told = rows("Trajectories")
    assert set(told) == {*FORMS, *REFUSED}
    for name, form in FORMS.items():
        assert told[name] == [f"`{form.file}`", form.how]
    for name, (file, _) in REFUSED.items():
        assert told[name] == [f"`{file}`", "refused"]
    stamps = rows("Stamps in names")
    assert set(stamps) == {*NAMES, *NUMBERS, *AMBIGUOUS_NAMES}
    for name, (written, _) in NAMES.items():
        assert stamps[name] == [f"`{written(1_700_000_000.25, 3)}`", "1700000000.25 s"]
    for name, number in NUMBERS.items():
        assert stamps[name] == [f"`{number(1_700_000_000.25, 3)}`", "order only"]
    for name, either in AMBIGUOUS_NAMES.items():
        assert stamps[name] == [f"`{either(1_700_000_000.25, 3)}`", "refused"]
    folders = rows("Folders as downloaded")
    assert set(folders) == {*FOLDERS, *(name for name, _, _ in OTHER_FOLDERS)}
    for name, folder in FOLDERS.items():
        assert folders[name][0] == f"`{folder.reader}`"
    for name, markers, advice in OTHER_FOLDERS:
        assert folders[name] == ["refused", ", ".join(f"`{marker}`" for marker in markers), "", "", advice]
