"""Whether flocc could be published as it stands: `make release-check`.

Builds the source distribution and the wheel, looks at both as an index would, installs the wheel into a fresh
environment and runs `flocc demo --small` there. Nothing is uploaded.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import zipfile
from pathlib import Path

from packaging.metadata import Metadata
from packaging.specifiers import SpecifierSet
from packaging.utils import parse_sdist_filename, parse_wheel_filename

ROOT = Path(__file__).parent.parent
DIST = ROOT / "dist"
WHEEL_BYTES_MAX = 3_000_000
NEEDED = (
    "LICENSE",
    "entry_points.txt",
    "flocc_launch/report/page.css",
    "flocc_launch/dashboard/page.html",
    "flocc_launch/scenarios/demo.toml",
    "flocc_agent/py.typed",
    "flocc_agent/perception/classical/codebook.npz",
)


def main() -> None:
    """Run all checks; the first that fails ends it with a sentence."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    check_changelog(version, (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    shutil.rmtree(DIST, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", str(DIST)], cwd=ROOT, check=True)
    (sdist,), (wheel,) = DIST.glob("*.tar.gz"), DIST.glob("*.whl")
    check_sdist(sdist, version)
    check_wheel(wheel, version)
    with tempfile.TemporaryDirectory() as folder:
        check_installed(wheel, Path(folder), version)
    print(f"flocc {version} can be published: {wheel.name}, {sdist.name}")  # noqa: T201


def check_changelog(version: str, text: str) -> None:
    """The version has a section of its own, with a date."""
    if not re.search(rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d$", text, re.M):
        sys.exit(f"CHANGELOG.md: has no section '## [{version}] - DATE'")


def check_metadata(text: bytes, version: str) -> None:
    """Metadata are valid as an index takes them, and say what pip and people need."""
    found = Metadata.from_email(text, validate=True)
    missing = [
        name
        for name, there in {
            "version": str(found.version) == version,
            "a requires-python that refuses 3.10": "3.10" not in (found.requires_python or SpecifierSet()),
            "a summary of one line": bool(found.summary) and "\n" not in (found.summary or ""),
            "a description in Markdown": found.description_content_type == "text/markdown" and bool(found.description),
            "a licence": found.license_expression == "Apache-2.0" and bool(found.license_files),
            "classifiers": bool(found.classifiers),
        }.items()
        if not there
    ]
    if missing:
        sys.exit(f"metadata: lack {', '.join(missing)}")


def check_sdist(path: Path, version: str) -> None:
    """The source distribution is named as it should be, and holds no rubbish."""
    assert parse_sdist_filename(path.name)[0] == "flocc"
    with tarfile.open(path) as archive:
        names = archive.getnames()
        info = archive.extractfile(f"flocc-{version}/PKG-INFO")
        assert info is not None
        check_metadata(info.read(), version)
    if rubbish := [name for name in names if "__pycache__" in name or name.endswith((".pyc", ".pth"))]:
        sys.exit(f"{path.name}: holds {rubbish[0]}")


def check_wheel(path: Path, version: str) -> None:
    """The wheel is pure, small, and has what is read at run time."""
    _, _, _, tags = parse_wheel_filename(path.name)
    if {str(tag) for tag in tags} != {"py3-none-any"}:
        sys.exit(f"{path.name}: is not a pure wheel")
    if path.stat().st_size > WHEEL_BYTES_MAX:
        sys.exit(f"{path.name}: has {path.stat().st_size} bytes, at most {WHEEL_BYTES_MAX} are sensible")
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        check_metadata(archive.read(f"flocc-{version}.dist-info/METADATA"), version)
    if lacking := [needed for needed in NEEDED if not any(name.endswith(needed) for name in names)]:
        sys.exit(f"{path.name}: lacks {lacking[0]}")
    if outside := [name for name in names if name.split("/")[0] not in PACKAGES | {f"flocc-{version}.dist-info"}]:
        sys.exit(f"{path.name}: would install {outside[0]}")


PACKAGES = {"flocc_protocol", "flocc_agent", "flocc_launch"}


def check_installed(wheel: Path, folder: Path, version: str) -> None:
    """A fresh environment with the wheel alone runs the small demo to its report."""
    subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
    python, flocc = folder / "venv/bin/python", folder / "venv/bin/flocc"
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    began_s = time.monotonic()
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), str(wheel)], check=True)
    installed_s = time.monotonic()
    environment = {**os.environ, "FLOCC_CACHE": str(folder / "cache"), "PYTHONPATH": ""}
    said = subprocess.run([str(flocc), "--version"], capture_output=True, text=True, check=True, cwd=folder).stdout
    if not said.startswith(f"flocc {version} "):
        sys.exit(f"the installed flocc says {said.strip()!r}")
    ran = subprocess.run([str(flocc), "demo", "--small", "--quiet"], cwd=folder, env=environment, check=False)
    report = folder / "runs/demo/report.html"
    if ran.returncode != 0 or not report.exists():
        sys.exit(f"flocc demo --small of the installed wheel ended with {ran.returncode}")
    merged_s = json.loads((folder / "runs/demo/report.json").read_text(encoding="utf-8"))["merged_after_s"]
    times = f"installed in {installed_s - began_s:.0f} s, demo in {time.monotonic() - installed_s:.0f} s"
    print(f"{times}, one map after {merged_s:.1f} s")  # noqa: T201


if __name__ == "__main__":
    main()
