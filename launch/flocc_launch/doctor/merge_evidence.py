"""What a run shows about two of its robots."""

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import ValidationError

from flocc_agent.config import RadioConfig
from flocc_agent.core.reports import CorrectionApplied
from flocc_agent.runtime.event_lines import of_kind
from flocc_launch.runs.closure_table import Pair
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_protocol.ids import LogId


def heard_s(loaded: LoadedRun, robot: str, peer: str) -> float:
    """For how long one robot heard another."""
    return sum(link.to_s - link.from_s for link in loaded.links if (link.robot, link.peer) == (robot, peer))


def emulated_radio(loaded: LoadedRun) -> str | None:
    """What of the radio was emulated from the start, in words; None where nothing was, or in a form not known here."""
    try:
        return RadioConfig.model_validate(without_nulls(loaded.run.radio)).parameters().emulated()
    except ValidationError:
        return None


def without_nulls(value: Any) -> Any:
    """JSON without keys that are null, which stand for defaults: `run.json` has no infinity."""
    if isinstance(value, dict):
        return {key: without_nulls(held) for key, held in value.items() if held is not None}
    return [without_nulls(held) for held in value] if isinstance(value, list) else value


def holds(loaded: LoadedRun, a: str, b: str) -> bool | None:
    """Whether one of two robots holds records of the other at the end; None where neither left a result."""
    results = [(loaded.results.get(a), b), (loaded.results.get(b), a)]
    known = [(result.logs, other) for result, other in results if result is not None]
    if not known:
        return None
    return any(held_records(logs, other) for logs, other in known)


def held_records(logs: Mapping[str, int], robot: str) -> int:
    """Records that are held of all logs of one robot."""
    return sum(count for log, count in logs.items() if LogId.parse(log).robot == robot)


def pairs_between(loaded: LoadedRun, a: str, b: str) -> list[Pair]:
    """Pairs of keyframes of two robots that anybody looked at."""
    return [pair for pair in loaded.pairs if {pair.query.log.robot, pair.match.log.robot} == {a, b}]


def best_similarity(loaded: LoadedRun, a: str, b: str) -> float | None:
    """Best similarity between two robots that either of them reports, below the threshold as well."""
    known = []
    for robot, other in ((a, b), (b, a)):
        result = loaded.results.get(robot)
        value = None if result is None else result.best_similarities.get(other)
        known += [] if value is None else [value]
    return max(known, default=None)


def components_join(components: Iterable[Iterable[LogId]], a: str, b: str) -> bool | None:
    """Whether one part of a solved graph holds both robots; None where the parts are not listed."""
    robots = [{log.robot for log in part} for part in components]
    return any({a, b} <= part for part in robots) if robots else None


def last_correction_s(loaded: LoadedRun, robot: str) -> float:
    """When a robot applied its last correction; before the start where it never did."""
    times_s = [event.t for event in of_kind(loaded.events, CorrectionApplied) if event.robot == robot]
    return max(times_s, default=float("-inf"))


def named(robots: Iterable[str]) -> str:
    """Names as in a sentence."""
    names = list(robots)
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
