"""The shipped scenarios, each with one thing made worse, and the expectations that it must then miss."""

from dataclasses import dataclass
from pathlib import Path

from flocc_launch.scenarios.shipped import FOLDER

APART = '\n[[faults]]\nat_s = 0.0\nkind = "partition"\ngroups = [["r1"], ["r2"]]\n'
LEAVES = '\n[[faults]]\nat_s = 5.0\nkind = "leave"\nrobots = ["server"]\n'


@dataclass(frozen=True, slots=True)
class Worse:
    """What is replaced in the file, what is added to it, and which expectations are missed."""

    replaced: tuple[tuple[str, str], ...]
    missed: frozenset[str]
    added: str = ""


UNMERGED = frozenset({"merged_within_s", "frames_max", "ate_max_m"})
"""Missed where robots end in two maps: an error over all of them has no value then."""

WORSE = {
    "meeting": Worse((("settle_s = 4.0", "duration_s = 22.0"),), UNMERGED | {"closures_min"}, APART),
    "corridor": Worse(
        (("[24, 0.0], [24, 1.5], [0, 1.5]]", "[24, 0.0]]"), ("[0, 1.5], [0, 0.0], [24, 0.0]]", "[0, 1.5]]")),
        UNMERGED | {"closures_min"},
    ),
    "rendezvous": Worse((('["r2", "r3"]', '["r1", "r2"]'),), UNMERGED),
    "partition-and-merge": Worse((("at_s = 9.0", "at_s = 26.0"),), frozenset({"merged_within_s"})),
    "heterogeneous": Worse((), frozenset({"leader", "leader_changes_max", "leader_registered_ratio_min"}), LEAVES),
}


def worse(name: str, folder: Path) -> Path:
    """Write a shipped scenario's worse variant."""
    text = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    for old, new in WORSE[name].replaced:
        assert text.count(old) == 1, (name, old)
        text = text.replace(old, new)
    path = folder / f"{name}.toml"
    path.write_text(text + WORSE[name].added, encoding="utf-8")
    return path
