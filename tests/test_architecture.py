"""Claims on the project as a whole: who imports whom, what starts fast, what a wheel holds, what is pinned."""

import ast
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import get_args

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from flocc_agent.core.effects import Effect
from flocc_agent.core.events import Event

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
HEAVY = ("torch", "gtsam", "cv2", "rerun", "zenoh")
HELP_CPU_MAX_S = 0.3
PACKAGES = {"flocc_protocol": "protocol", "flocc_agent": "agent", "flocc_launch": "launch"}
SOURCES = os.pathsep.join(str(ROOT / root) for root in [*PACKAGES.values(), "lab"])
ROOMS_MAX = 20
"""Files and folders at the top of flocc_launch."""


def run(*command: str) -> subprocess.CompletedProcess[str]:
    """Run a Python program from the sources; its error output is part of a failure's message."""
    environment = os.environ | {"PYTHONPATH": SOURCES}
    done = subprocess.run([sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done


def cpu_s(*command: str) -> float:
    """User and system time of one run of a Python program, in seconds."""
    before = os.times()
    run(*command)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def test_the_import_contracts_hold() -> None:
    kept = run("-c", "from importlinter.cli import lint_imports_command; lint_imports_command()").stdout
    assert f"Contracts: {len(PROJECT['tool']['importlinter']['contracts'])} kept, 0 broken" in kept


def test_launch_has_few_rooms() -> None:
    rooms = [path.name for path in (ROOT / "launch" / "flocc_launch").iterdir() if path.name != "__pycache__"]
    assert len(rooms) <= ROOMS_MAX, sorted(rooms)


def test_no_product_file_names_the_shared_folder() -> None:
    files = [path for package, root in PACKAGES.items() for path in (ROOT / root / package).rglob("*.py")]
    assert [path for path in files if "../shared" in path.read_text(encoding="utf-8")] == []


def test_without_the_lab_its_commands_say_where_it_is(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(str(ROOT / root) for root in PACKAGES.values())}
    hide = "import sys; sys.path = [p for p in sys.path if not p.endswith('/lab')]; "
    program = hide + "from flocc_launch.commands.main import main; main()"
    words = ["experiment", "scale", "--quick"]
    done = subprocess.run(
        [sys.executable, "-c", program, *words], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr == (
        "error: flocc experiment is part of the lab, which is not installed: clone flocc, then pip install -e .\n"
    )


@pytest.mark.parametrize(
    "module", ["flocc_protocol", "flocc_agent", "flocc_agent.config", "flocc_launch.commands.main"]
)
def test_an_import_pulls_in_nothing_heavy(module: str) -> None:
    program = f"import {module}, sys; print([name for name in {HEAVY} if name in sys.modules])"
    assert run("-c", program).stdout.strip() == "[]"


def test_help_answers_at_once() -> None:
    times_s = [cpu_s("-c", "from flocc_launch.commands.main import main; main()", "--help") for _ in range(4)]
    assert min(times_s) < HELP_CPU_MAX_S, times_s


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The names of all files of a freshly built wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    run("-m", "hatchling", "build", "-t", "wheel", "-d", str(folder))
    (wheel,) = folder.glob("flocc-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_a_wheel_holds_the_three_packages_and_nothing_else(wheel_names: set[str]) -> None:
    folders = {name.split("/")[0] for name in wheel_names}
    assert {name for name in folders if not name.endswith(".dist-info")} == PACKAGES.keys()
    assert {f"{package}/py.typed" for package in PACKAGES} <= wheel_names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in wheel_names)


def test_every_file_of_the_packages_is_in_the_wheel(wheel_names: set[str]) -> None:
    files = {
        str(path.relative_to(ROOT / root))
        for package, root in PACKAGES.items()
        for path in (ROOT / root / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files <= wheel_names, sorted(files - wheel_names)


def test_every_requirement_is_pinned_within_its_range() -> None:
    pins = dict(
        line.split("==")
        for line in (ROOT / "constraints.txt").read_text().split("\n")
        if re.fullmatch(r"\S+==\S+", line)
    )
    extras = PROJECT["project"]["optional-dependencies"].values()
    required = [*PROJECT["project"]["dependencies"], *(line for extra in extras for line in extra)]
    for requirement in map(Requirement, required):
        name = canonicalize_name(requirement.name)
        if name == "flocc":
            continue
        assert name in pins, f"{name} is not in constraints.txt; run `make constraints`"
        assert requirement.specifier.contains(pins[name]), f"{name} {pins[name]} is outside {requirement.specifier}"


def test_the_agents_page_names_every_file_of_the_core_and_every_effect() -> None:
    page = (ROOT / "agent/README.md").read_text(encoding="utf-8")
    files = {path.name for path in (ROOT / "agent/flocc_agent/core").glob("*.py")} - {"__init__.py"}
    kinds = {kind.__name__ for kind in (*get_args(Effect), *get_args(Event))}
    assert [name for name in sorted(files | kinds) if f"`{name}`" not in page] == []
    named = {name for row in page.splitlines() if row.startswith("| `") for name in re.findall(r"`(\w+\.py)`", row)}
    assert named - files == set(), "files that are no longer there"


@cache
def parsed(path: Path) -> ast.Module:
    """A module as Python reads it; many seconds for all of them."""
    return ast.parse(path.read_text(encoding="utf-8"))


def product_files() -> list[Path]:
    """Every module of the four source roots."""
    return [path for root in ("protocol", "agent", "launch", "lab") for path in sorted((ROOT / root).rglob("*.py"))]


def places_of(names: Iterable[tuple[str, Path]], allowed: Mapping[str, str]) -> dict[str, list[str]]:
    """Names that stand in more than one place -> these places, but for those with a reason."""
    places: dict[str, list[str]] = {}
    for name, path in names:
        places.setdefault(name, []).append(str(path.relative_to(ROOT)))
    return {name: where for name, where in places.items() if len(where) > 1 and name not in allowed}


FILES_TWICE = {"__init__.py": "Python's", "__main__.py": "Python's"}
CLASSES_TWICE = {
    "Trajectory": "of a log in a pose graph, and of stamped poses in a file: the word of the field for both",
}
"""Names that may stand twice, and why; take one out when its reason is gone."""


def test_no_two_files_have_one_name() -> None:
    assert places_of(((path.name, path) for path in product_files()), FILES_TWICE) == {}


def test_no_two_classes_have_one_name() -> None:
    classes = [
        (node.name, path)
        for path in product_files()
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.ClassDef)
    ]
    assert places_of(classes, CLASSES_TWICE) == {}
    assert CLASSES_TWICE.keys() <= {name for name, _ in classes}, "a name that is allowed twice is not there at all"


SHELL = {"asyncio", "zenoh", "rclpy"}
SHELL_RATIO_MAX = 0.10


def imported(path: Path) -> set[str]:
    """Top names of all that a module imports, also inside of functions."""
    found: set[str] = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found


def test_the_asyncio_and_zenoh_shell_is_a_tenth_of_the_product_at_most() -> None:
    """Every line of a module counts that imports one of them anywhere."""
    product = [path for path in product_files() if path.relative_to(ROOT).parts[0] != "lab"]
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in product}
    shell = sum(count for path, count in lines.items() if imported(path) & SHELL)
    assert shell < SHELL_RATIO_MAX * sum(lines.values()), f"{shell} of {sum(lines.values())} lines"
