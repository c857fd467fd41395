"""The documentation: commands in it run, links lead somewhere, the configuration reference is the models'."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from flocc_launch.config_reference import reference

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "protocol/README.md", ROOT / "agent/README.md"])
SHELL_BLOCK = re.compile(r"```sh\n(.*?)```", re.DOTALL)
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
QUICK = ("flocc simulate", "flocc doctor", "flocc evaluate", "flocc launch", "flocc dataset", "flocc optimise")


def commands(page: Path) -> list[str]:
    """Commands of flocc in a page's shell blocks, without comments; lines with placeholders are not commands."""
    lines = [
        line.split("  #")[0].strip() for block in SHELL_BLOCK.findall(page.read_text()) for line in block.splitlines()
    ]
    return [line for line in lines if line.startswith(QUICK) and not re.search(r"[A-Z]{3,}|<|\.\.\.|path/to", line)]


def test_the_configuration_reference_is_generated_from_the_models() -> None:
    assert (ROOT / "docs/configuration.md").read_text(encoding="utf-8") == reference()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    links = [link for link in LINK.findall(page.read_text(encoding="utf-8")) if "://" not in link]
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.swarm
@pytest.mark.slow
def test_the_commands_of_the_readme_run(tmp_path: Path) -> None:
    found = commands(ROOT / "README.md")
    assert len(found) >= 5
    environment = {**os.environ, "FLOCC_CACHE": str(tmp_path / "cache")}
    for command in found:
        arguments = [sys.executable, "-m", "flocc_launch.cli", *command.split()[1:]]
        ran = subprocess.run(arguments, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, f"{command}: {ran.stdout}{ran.stderr}"
