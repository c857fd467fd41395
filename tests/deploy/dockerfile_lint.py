"""Reads Dockerfiles, and checks the rules that matter here; hadolint's numbers stand beside those that are also its."""

import fnmatch
import json
import re
from dataclasses import dataclass
from pathlib import Path

SHELL_FORM = ("CMD", "ENTRYPOINT")


@dataclass(frozen=True, slots=True)
class Instruction:
    """One instruction, its continued lines joined."""

    name: str
    text: str


def instructions(text: str) -> list[Instruction]:
    """Instructions of a Dockerfile, without comments."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines)).splitlines()
    return [Instruction(name.upper(), rest.strip()) for name, _, rest in (line.partition(" ") for line in joined)]


def stages(text: str) -> list[list[Instruction]]:
    """The instructions of each stage, its FROM first; ARG before the first FROM belongs to none."""
    found: list[list[Instruction]] = []
    for each in instructions(text):
        if each.name == "FROM":
            found.append([])
        if found:
            found[-1].append(each)
    return found


def faults(text: str, context: Path) -> list[str]:
    """Every rule that a Dockerfile breaks, in words."""
    every = instructions(text)
    defaults = dict(each.text.split("=", 1) for each in every if each.name == "ARG" and "=" in each.text)
    built = {words[2] for words in (each.text.split() for each in every if each.name == "FROM") if len(words) == 3}
    found = [fault for each in every for fault in _faults_of(each, context, defaults, built)]
    return found + _faults_of_the_last(stages(text)[-1])


def _faults_of(each: Instruction, context: Path, defaults: dict[str, str], built: set[str]) -> list[str]:
    match each.name:
        case "FROM":
            return _base_faults(each.text.split()[0], defaults, built)
        case "RUN":
            return _run_faults(each.text)
        case "COPY":
            return _copy_faults(each.text, context)
        case "ADD":
            return ["DL3020: COPY does what ADD is used for"]
        case "CMD" | "ENTRYPOINT":
            return [] if _is_list(each.text) else [f"DL3025: {each.name} is no list, so signals do not arrive"]
        case _:
            return []


def _base_faults(image: str, defaults: dict[str, str], built: set[str]) -> list[str]:
    image = re.sub(r"\$\{(\w+)\}", lambda m: defaults.get(m[1], ""), image)
    tag = image.rsplit("/", 1)[-1].partition(":")[2]
    if image in built or (tag and tag != "latest"):
        return []
    return [f"DL3006, DL3007: the base {image!r} has no fixed tag"]


def _run_faults(command: str) -> list[str]:
    found = []
    if re.search(r"\bapt-get\b.*\binstall\b", command):
        found += [] if "--no-install-recommends" in command else ["DL3015: apt-get without --no-install-recommends"]
        found += [] if re.search(r"rm -rf? /var/lib/apt/lists", command) else ["DL3009: apt lists are left"]
    if re.search(r"\bapt install\b", command):
        found.append("DL3027: apt is for people, apt-get for programs")
    if "pip install" in command and "--no-cache-dir" not in command:
        found.append("DL3042: pip keeps its cache in the image")
    return found + (["DL3004: sudo"] if re.search(r"\bsudo\b", command) else [])


def _copy_faults(text: str, context: Path) -> list[str]:
    words = text.split()
    if words[0].startswith("--from="):
        return []
    sources = [word for word in words[:-1] if not word.startswith("--")]
    missing = [f"COPY: {source} is not there" for source in sources if not (context / source).exists()]
    return missing + [f"COPY: {source} is kept out by .dockerignore" for source in sources if _ignored(source, context)]


def _ignored(path: str, context: Path) -> bool:
    """Whether .dockerignore keeps a path of the context out; the last line that fits counts."""
    ignored = False
    for line in (context / ".dockerignore").read_text().splitlines():
        pattern = line.strip().removeprefix("!")
        if pattern and not line.startswith("#") and fnmatch.fnmatch(path, pattern):
            ignored = not line.startswith("!")
    return ignored


def _faults_of_the_last(stage: list[Instruction]) -> list[str]:
    names = {each.name for each in stage}
    users = [each.text.split(":")[0] for each in stage if each.name == "USER"]
    found = [] if users and users[-1] not in ("root", "0") else ["DL3002: it runs as root"]
    found += [] if "HEALTHCHECK" in names else ["DL3057: there is no health check"]
    return found + ([] if "ENTRYPOINT" in names else ["there is no ENTRYPOINT"])


def _is_list(text: str) -> bool:
    try:
        return isinstance(json.loads(text), list)
    except ValueError:
        return False
