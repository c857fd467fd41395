"""What would be published, and that everything that runs on other machines calls the targets of the Makefile."""

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from ruamel.yaml import YAML
from tests.doc_commands import ROOT

from flocc_launch.runs.version import flocc_version


def release_check() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release_check", ROOT / ".ci/release_check.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_both_distributions_are_as_an_index_takes_them(tmp_path: Path) -> None:
    check: Any = release_check()
    build = [sys.executable, "-m", "hatchling", "build", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (sdist,), (wheel,) = tmp_path.glob("*.tar.gz"), tmp_path.glob("*.whl")
    check.check_sdist(sdist, flocc_version())
    check.check_wheel(wheel, flocc_version())


@pytest.mark.parametrize(
    ("change", "lacks"),
    [
        (("Requires-Python: <3.15,>=3.11\n", ""), "a requires-python that refuses 3.10"),
        (("Requires-Python: <3.15,>=3.11\n", "Requires-Python: >=3.9\n"), "a requires-python that refuses 3.10"),
        (("Version: 0.1.0", "Version: 0.2.0"), "version"),
        (("License-Expression: Apache-2.0\n", ""), "a licence"),
        (("Summary: s\n", ""), "a summary of one line"),
    ],
)
def test_what_metadata_lack_is_named(change: tuple[str, str], lacks: str) -> None:
    check: Any = release_check()
    text = (
        "Metadata-Version: 2.4\nName: flocc\nVersion: 0.1.0\nSummary: s\nLicense-Expression: Apache-2.0\n"
        "License-File: LICENSE\nClassifier: Typing :: Typed\nRequires-Python: <3.15,>=3.11\n"
        "Description-Content-Type: text/markdown\n\n# flocc\n"
    )
    check.check_metadata(text.encode(), "0.1.0")
    with pytest.raises(SystemExit, match=f"metadata: lack {lacks}"):
        check.check_metadata(text.replace(*change).encode(), "0.1.0")


def test_the_version_has_its_section_among_the_changes() -> None:
    check: Any = release_check()
    check.check_changelog(flocc_version(), (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    with pytest.raises(SystemExit, match=r"no section '## \[9\.9\.9\] - DATE'"):
        check.check_changelog("9.9.9", "## [0.1.0] - 2026-11-30\n")


def targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))


def test_the_workflow_and_the_dev_container_call_targets_that_there_are() -> None:
    workflow = YAML(typ="safe", pure=True).load(ROOT / ".github/workflows/tests.yml")
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    runs = [step["run"] for step in steps if "run" in step]
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text(encoding="utf-8"))
    called = [*runs, container["postCreateCommand"]]
    assert {words[0] for words in map(str.split, called)} == {"make"}
    assert {words[1] for words in map(str.split, called)} <= targets()
    assert {"make test", "make docs", "make release-check"} <= set(runs)


def test_every_extra_is_named_as_it_can_be_installed() -> None:
    """Until flocc is published, `pip install flocc[...]` would bring something of a stranger's."""
    wrong = r"pip install (-[^ ]+ )*'?flocc(\[|'| |$)"
    places = ("*.md", "*.py", ":!tests", ":!CHANGELOG.md")
    command = ["git", "grep", "-nE", wrong, "--", *places]
    named = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if named.returncode > 1:
        pytest.skip("not a clone")
    assert named.stdout == ""
