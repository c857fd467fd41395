"""Commands in the documentation: where they stand, and whether a command that is not run would be understood.

Blocks of `sh` or `bash` are run as they stand, in the order of the page and in one folder per page, unless the line
above the fence is `<!-- not run: why -->` (tests/test_docs.py). Those, synopses (blocks without a language) and
commands in running text are parsed: their command and every option must exist. Blocks of `toml` or `yaml` whose first
line is `# NAME.toml` are written to the page's folder, and blocks of `python` are run there, by the same rule.
"""

import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import typer
import typer.main

from flocc_launch.commands.main import app, with_ros_args
from flocc_protocol.errors import FloccError

ROOT = Path(__file__).parents[1]
USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]  # of typer's own click, whose place changes
FENCE = re.compile(r"(?:^<!-- not run: (?P<why>[^>]*?) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```", re.M | re.S)
SPAN = re.compile(r"`((?:[A-Z_]+=\S+ )*(?:flocc|python -m|make|pytest) [^`]+)`")
FILE_NAME = re.compile(r"# (?:[^\s]*/)?([\w.-]+\.(?:toml|yaml))\b")
SHELL = ("sh", "bash")
PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b|^[A-Z]$|<|\.\.\.")
RUNNABLE = {"flocc", "python", "cd", "cp", "mkdir", "ls", "cat", "echo", "kill", "wait", "sleep", "sed", "evo_ape"}
ENDLESS = (["flocc", "agent"], ["flocc", "dashboard"])
OTHER_PROGRAMS = {
    "apt", "apt-get", "cd", "cp", "curl", "docker", "evo_ape", "export", "git", "ip", "journalctl", "mkdir", "pip",
    "python3", "ros2", "scp", "ssh", "sudo", "sysctl", "systemctl", "tc", "useradd", "install", "source", "openssl",
    "iperf3", "nmcli", "iw", "chown", "chmod", "echo", "cat", "ls", "hadolint", "ping", "tee", "rosdep", "colcon",
    "ros2_environment",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block of a page.

    Attributes:
        page: Where it stands.
        language: After the fence; "" where there is none.
        text: What is inside.
        why_not: Why it is not run, or None.
    """

    page: Path
    language: str
    text: str
    why_not: str | None


def blocks(page: Path) -> list[Block]:
    """Fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [Block(page, m["language"], m["text"], m["why"]) for m in FENCE.finditer(text)]


def named_options(page: Path) -> set[str]:
    """Options that a page names by themselves, as `--seed` or `--seed N`, outside of its commands and blocks."""
    return set(re.findall(r"`(--[a-z][a-z0-9-]*)[^`]*`", FENCE.sub("", page.read_text(encoding="utf-8"))))


def unknown_options(page: Path) -> set[str]:
    """Of the options that a page names by themselves, those of no command of flocc and of no module that it names."""
    unknown = named_options(page) - {option for options in commands().values() for option in options}
    modules = set(re.findall(r"python -m (flocc_\w+(?:\.\w+)+)", page.read_text(encoding="utf-8")))
    unknown = {option for option in unknown if not any(f'"{option}"' in _source(module) for module in modules)}
    return {option for option in unknown if not any(_takes(module, option) for module in sorted(modules))}


@cache
def commands() -> dict[str, tuple[str, ...]]:
    """Every command of flocc, as `dataset info`, with the long forms of its options, as `--help` lists them."""
    return dict(_commands(_root(), ""))


@cache
def _root() -> Any:
    return typer.main.get_command(app)


def _commands(command: Any, path: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    if not hasattr(command, "list_commands"):
        options = [option for p in command.params for option in (*p.opts, *p.secondary_opts)]
        yield path.strip(), tuple(option for option in options if option.startswith("--"))
        return
    for name in command.list_commands(None):
        yield from _commands(command.get_command(None, name), f"{path} {name}")


def script(page: Path) -> str:
    """What is run of a page, as one bash script; "" where there is nothing."""
    steps = []
    for number, block in enumerate(found for found in blocks(page) if found.why_not is None):
        named = FILE_NAME.match(block.text)
        if block.language in SHELL:
            steps.append(block.text)
        elif block.language == "python":
            steps.append(f"cat > block{number}.py <<'END'\n{block.text}END\npython block{number}.py\n")
        elif named:
            steps.append(f"cat > {named[1]} <<'END'\n{block.text}END\n")
    return "\n".join(steps) if any(step for step in steps if not step.startswith("cat > ") or "python" in step) else ""


def parsed_commands(page: Path) -> list[str]:
    """Commands of a page that are parsed only: in blocks that are not run, in synopses and in running text."""
    text = page.read_text(encoding="utf-8")
    spans = [" ".join(match.split()) for match in SPAN.findall(FENCE.sub("", text))]
    found = [f"{span} ..." if span.rsplit(" ", 1)[-1].startswith("--") else span for span in spans]
    for block in blocks(page):
        if block.language in SHELL and block.why_not is not None:
            found += command_lines(block.text)
        elif block.language == "":
            found += [line for line in command_lines(block.text) if line.startswith(("flocc ", "python -m"))]
    return found


def command_lines(text: str) -> list[str]:
    """Lines of a block without comments; continued ones are joined."""
    lines = re.sub(r"\\\n\s*", "", text).splitlines()
    stripped = [re.split(r"\s{2,}|\s#\s", line.strip().removeprefix("$ "))[0] for line in lines]
    return [line for line in stripped if line and not line.startswith("#")]


def runnable(line: str) -> bool:
    """Whether a command may run inside the tests: nothing that installs, needs rights, or tests itself."""
    words = shlex.split(line)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    forbidden = (["-m", "pip"], ["-m", "pytest"])
    return bool(words) and words[0] in RUNNABLE and words[1:3] not in forbidden and words[:2] not in ENDLESS


def complaint(command: str) -> str | None:
    """What is wrong with a command that is not run, or None."""
    try:
        words = [word.strip("[]") for word in shlex.split(command.split(" | ")[0])]
    except ValueError as error:
        return str(error)
    while words and (re.fullmatch(r"[A-Z_]+=.*", words[0]) or words[0] in ("sudo", "-E", "exec")):
        words = words[1:]
    program = Path(words[0]).name if words else ""
    if program == "flocc":
        return _flocc_complaint(words[1:])
    if program == "pytest" or words[1:3] == ["-m", "pytest"]:
        return _paths_complaint(words[1:])
    if program == "make":
        return _make_complaint(words[1:])
    if program in ("python", "python3") and len(words) > 2 and words[1] == "-m":
        return _module_complaint(words[2], words[3:])
    if program == "python" and len(words) > 1:
        return None if (ROOT / words[1]).is_file() else f"{words[1]} is not there"
    return None if program in OTHER_PROGRAMS else f"{program!r} is not a program that these pages may use"


def _flocc_complaint(words: list[str]) -> str | None:
    """What the command line itself says; values may be placeholders, names of commands and options may not."""
    command = _root()
    words = with_ros_args(words)
    typed = not any(PLACEHOLDER.search(word) for word in words)
    path = ["flocc"]
    while getattr(command, "commands", None) and words and not words[0].startswith("-"):
        if PLACEHOLDER.search(words[0]):
            return None
        found = _subcommand(command, words[0])
        if found is None:
            return f"{' '.join(path)} has no command {words[0]!r}"
        command = found
        path.append(words.pop(0))
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    unknown = [word for word in words if word.startswith("--") and word.split("=")[0] not in {*known, "--help"}]
    if unknown:
        return f"{' '.join(path)} has no option {unknown[0]}"
    complete = typed and words and not getattr(command, "commands", None)
    return _strictly(command, path[-1], words) if complete else None


def _subcommand(group: Any, name: str) -> Any:
    """A command of a group, also of one that makes its commands when they are called for."""
    try:
        return group.get_command(None, name)
    except FloccError:
        return None


def _strictly(command: Any, name: str, words: list[str]) -> str | None:
    """The command line's own judgement of a command that could be typed as it stands; `--help` is fine."""
    if "--help" in words:
        return None
    try:
        command.make_context(name, words)
    except USAGE_ERROR as error:
        return str(error)
    return None


def _paths_complaint(words: list[str]) -> str | None:
    paths = [word.split("::")[0] for word in words if word.startswith("tests/")]
    return next((f"{path} is not there" for path in paths if not (ROOT / path).exists()), None)


def _make_complaint(words: list[str]) -> str | None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    unknown = [word for word in words if "=" not in word and word not in targets]
    return f"the Makefile has no target {unknown[0]}" if unknown else None


def _module_complaint(module: str, words: list[str]) -> str | None:
    if module in ("pip", "venv"):
        return None
    if importlib.util.find_spec(module) is None:
        return f"there is no module {module}"
    options = [word.split("=")[0] for word in words if word.startswith("--")]
    unknown = [option for option in options if not _takes(module, option)]
    return f"{module} has no option {unknown[0]}" if unknown else None


def _takes(module: str, option: str) -> bool:
    """Whether a module has an option: it stands in its source, or else in its help, which takes a second to ask for."""
    return f'"{option}"' in _source(module) or re.search(rf"{option}(?![\w-])", _help(module)) is not None


def _source(module: str) -> str:
    """Of a module, or of what runs of a package; "" where it is not there."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return ""
    path = Path(spec.origin)
    path = path.with_name("__main__.py") if path.name == "__init__.py" else path
    return path.read_text(encoding="utf-8") if path.is_file() else ""


@cache
def _help(module: str) -> str:
    ran = subprocess.run(
        [sys.executable, "-m", module, "--help"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    return ran.stdout
