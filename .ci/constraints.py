"""Print the versions in this environment of everything that flocc and its extras need: `make constraints`."""

import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).parent.parent / "pyproject.toml"
OTHER_PLATFORMS = re.compile(r"nvidia|cuda|triton")


def closure(requirements: list[Requirement]) -> dict[str, str]:
    """Version by name of the requirements and of what they require, as installed here."""
    versions: dict[str, str] = {}
    done: set[tuple[str, frozenset[str]]] = set()
    waiting = list(requirements)
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if (name, frozenset(requirement.extras)) in done or OTHER_PLATFORMS.match(name):
            continue
        done.add((name, frozenset(requirement.extras)))
        try:
            installed = distribution(name)
        except PackageNotFoundError:
            raise SystemExit(f"{name} is not installed here; run `make test` first") from None
        versions[name] = installed.version.split("+")[0]
        waiting += [needed for needed in map(Requirement, installed.requires or []) if _applies(needed, requirement)]
    return versions


def _applies(needed: Requirement, parent: Requirement) -> bool:
    environment = {key: str(value) for key, value in default_environment().items()}
    extras = parent.extras or {""}
    return needed.marker is None or any(needed.marker.evaluate(environment | {"extra": extra}) for extra in extras)


def main() -> None:
    """Print one pin per line, in order."""
    project = tomllib.loads(PROJECT.read_text())
    names = [*project["build-system"]["requires"], *project["project"]["dependencies"]]
    for extra in project["project"]["optional-dependencies"].values():
        names += extra
    requirements = [Requirement(name) for name in names if not name.startswith("flocc[")]
    lines = ["# What flocc is tested with on Python 3.11; written by `make constraints`."]
    lines += [f"{name}=={version}" for name, version in sorted(closure(requirements).items())]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
