"""The documentation: commands in it run, links lead somewhere, the configuration reference is the models'."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError
from tests.doc_commands import (
    ROOT,
    SHELL,
    blocks,
    command_lines,
    commands,
    complaint,
    parsed_commands,
    runnable,
    script,
    unknown_options,
)
from tests.doc_props import write_bag, write_own_data

from flocc_agent.config import AgentConfig, ConfigError, refuse_removed
from flocc_lab.reference.configuration_page import reference
from flocc_launch.scenarios.scenario import Scenario

PARTS = ("protocol", "agent", "docker")
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *(ROOT / part / "README.md" for part in PARTS)])
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
TABLES = "core|keyframes|perception|backend|radio|store|transport|source|ros2|metrics"
KEY = re.compile(rf"`((?:{TABLES})\.[a-z_0-9.]*[a-z0-9](?<!\.py))(?: = [^`]*)?`")
OF_OTHER_PROGRAMS = {"--build-arg", "--system-site-packages", "--clock"}  # docker, python -m venv, ros2 bag
NOT_ON_PAGES = {"--no-secure", "--no-verbose"}  # what is so without an option
LIVE = re.compile(r"^flocc (launch|demo|agent|experiment)\b|^python examples/", re.M)


def page_id(page: Path) -> str:
    return str(page.relative_to(ROOT))


def run_pages() -> list[object]:
    """Pages with something to run; those that start agents are tests of live swarms."""
    marks = {True: [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow], False: []}
    scripts = {page: script(page) for page in PAGES}
    return [
        pytest.param(page, marks=marks[bool(LIVE.search(text))], id=page_id(page))
        for page, text in scripts.items()
        if text
    ]


@pytest.fixture(scope="session")
def props(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages' commands find in their folder, and a cache for what they generate."""
    folder = tmp_path_factory.mktemp("props")
    write_own_data(folder / "my_data")
    for name in ("rover", "drone"):
        shutil.copytree(folder / "my_data", folder / "my_robots" / name)
    write_bag(folder / "run.bag")
    return folder


def in_shell(text: str, folder: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    """Run a script with the installed programs, stopping at the first command that fails."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "FLOCC_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-x", "-c", text],
        cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=240,
    )  # fmt: skip


def test_the_configuration_reference_is_generated_from_the_models() -> None:
    assert (ROOT / "docs/configuration.md").read_text(encoding="utf-8") == reference()


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_link_leads_somewhere(page: Path) -> None:
    links = [link for link in LINK.findall(page.read_text(encoding="utf-8")) if "://" not in link]
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_the_index_names_every_page() -> None:
    named = set(LINK.findall((ROOT / "docs/README.md").read_text(encoding="utf-8")))
    assert [page.name for page in ROOT.glob("docs/*.md") if page.name not in {*named, "README.md"}] == []


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_command_is_known_with_its_options(page: Path) -> None:
    complaints = {command: complaint(command) for command in parsed_commands(page)}
    assert {command: why for command, why in complaints.items() if why is not None} == {}


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_options_that_a_page_names_alone_exist(page: Path) -> None:
    assert sorted(unknown_options(page) - OF_OTHER_PROGRAMS) == []


def test_every_command_and_option_stands_on_a_page() -> None:
    """What `--help` says and no page does nobody finds by searching; options of single experiments are too many."""
    pages = "\n".join(page.read_text(encoding="utf-8") for page in PAGES if page.name != "CHANGELOG.md")
    words = set(re.findall(r"--[a-z][a-z0-9-]*", pages))
    assert [command for command in commands() if f"flocc {command}" not in pages] == []
    wanted = {command: options for command, options in commands().items() if not command.startswith("experiment ")}
    missing = {command: sorted({*options} - words - NOT_ON_PAGES) for command, options in wanted.items()}
    assert {command: options for command, options in missing.items() if options} == {}


@pytest.mark.parametrize("option", ["--json", "--quiet", "--verbose"])
def test_the_page_of_commands_says_which_commands_take_an_option(option: str) -> None:
    table = (ROOT / "docs/commands.md").read_text(encoding="utf-8")
    (cell,) = re.findall(rf"^\| `{option}`[^|]*\| ([^|]+) \|", table, re.M)
    named = {name for word in re.findall("`([^`]+)`", cell) for name in commands() if f"{name} ".startswith(f"{word} ")}
    assert named == {name for name, options in commands().items() if option in options}


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_block_is_run_or_says_why_not(page: Path) -> None:
    shell = [block for block in blocks(page) if block.language in SHELL and block.why_not is None]
    foreign = [line for block in shell for line in command_lines(block.text) if not runnable(line)]
    assert foreign == [], "mark the block: <!-- not run: why --> on the line above its fence"


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_keys_that_a_page_names_exist(page: Path) -> None:
    named = set(KEY.findall(page.read_text(encoding="utf-8")))
    known = (ROOT / "docs/configuration.md").read_text(encoding="utf-8")
    assert [key for key in sorted(named) if f"`{key}`" not in known and f"[{key}]" not in known] == []


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_configurations_on_a_page_have_no_key_that_is_unknown(page: Path) -> None:
    tables = [tomllib.loads(block.text) for block in blocks(page) if block.language == "toml"]
    assert [table for table in tables if unknown_keys(AgentConfig, table) and unknown_keys(Scenario, table)] == []


def unknown_keys(model: type[BaseModel], table: dict[str, object]) -> list[str]:
    """Keys of a fragment that a model does not have; what a fragment lacks does not matter."""
    try:
        refuse_removed(table, "page")
        model.model_validate(table, context={"folder": None})
    except ValidationError as error:
        return [".".join(map(str, e["loc"])) for e in error.errors() if e["type"] == "extra_forbidden"]
    except ConfigError as error:
        return [str(error)]
    return []


def test_an_unknown_key_is_noticed() -> None:
    table: dict[str, object] = {"keyframes": {"distanse_m": 0.1}}
    assert unknown_keys(AgentConfig, table) == unknown_keys(Scenario, table) == ["keyframes.distanse_m"]
    assert KEY.findall("`core.gossip.request_timeout_s = 2` and `core/gossip.py`") == ["core.gossip.request_timeout_s"]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", run_pages())
def test_the_commands_of_a_page_run(page: Path, props: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(props, tmp_path / "folder"))
    (folder / "examples").symlink_to(ROOT / "examples")
    ran = in_shell(script(page), folder, props.parent / "cache")
    assert ran.returncode == 0, f"{ran.stdout[-2000:]}\n{ran.stderr[-3000:]}"


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("flocc lunch meeting", "no command 'lunch'"),
        ("flocc dataset konvert x", "no command 'konvert'"),
        ("flocc launch meeting --losss 0.1", "no option --losss"),
        ("flocc launch SCENARIO --losss 0.1", "no option --losss"),
        ("flocc dataset convert path/to/data", "Missing parameter: out"),
        ("flocc launch meeting --seed four", "not a valid|valid integer"),
        ("python -m flocc_launch.nothing", "there is no module"),
        ("python -m flocc_lab.reliability idle --runz 3", "no option --runz"),
        ("make tset", "no target tset"),
        ("FLOCC_SHARED=/data pytest -s tests/no_test.py -k some", "tests/no_test.py is not there"),
        ("rosrun flocc", "not a program"),
    ],
)
def test_a_wrong_command_is_noticed(command: str, why: str) -> None:
    assert re.search(why, complaint(command) or "fine")


def test_a_right_command_passes() -> None:
    for command in ("flocc launch ... --dashboard 8080", "flocc dataset info | convert", "make test", "flocc --help"):
        assert complaint(command) is None


def test_blocks_are_found_with_what_keeps_them_from_running(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```sh\nflocc doctor  # fine\n```\n\n<!-- not run: needs a GPU -->\n```bash\nflocc weights \\\n  status\n```\n"
        "`flocc keys FOLDER` and\n```toml\n# robot.toml\nname = 'r1'\n```\n```\nflocc status RUN   shows it\n```\n"
    )
    assert [(block.language, block.why_not) for block in blocks(page)] == [
        ("sh", None), ("bash", "needs a GPU"), ("toml", None), ("", None),
    ]  # fmt: skip
    assert script(page) == "flocc doctor  # fine\n\ncat > robot.toml <<'END'\n# robot.toml\nname = 'r1'\nEND\n"
    assert parsed_commands(page) == ["flocc keys FOLDER", "flocc weights status", "flocc status RUN"]


def test_a_script_stops_at_the_first_command_that_fails(tmp_path: Path) -> None:
    assert in_shell("false\necho on", tmp_path, tmp_path).stdout == ""
