"""Run methods on seeds of the family, one row per answer, and a table: medians, tails, failures.

Rows go to a file of JSON lines as they come, so that a campaign that was stopped can go on where it was.
"""

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from flocc_lab.graph_family.graphs import KnownGraph, member
from flocc_lab.graph_family.judge import GraphVerdict, judged
from flocc_lab.graph_family.methods import Method, MethodAnswer, NoAnswer, oracle


def run(
    seeds: Iterable[int],
    methods: Mapping[str, Method],
    rows: Path | None,
    limit_s: float,
    graph_of: Callable[[int], KnownGraph] = member,
) -> list[GraphVerdict]:
    """Judge every method on every seed, until the time is over; rows that the file has are not run again."""
    done = read_rows(rows) if rows is not None else []
    known, began = {(v.seed, v.method) for v in done}, time.monotonic()
    for seed in seeds:
        missing = {name: method for name, method in methods.items() if (seed, name) not in known}
        if not missing:
            continue
        if time.monotonic() - began > limit_s:
            break
        graph = graph_of(seed)
        best = oracle(graph)
        for name, method in missing.items():
            verdict = verdict_of(graph, name, method, best)
            done.append(verdict)
            if rows is not None:
                with rows.open("a", encoding="utf-8") as out:
                    out.write(json.dumps(asdict(verdict)) + "\n")
    return done


def verdict_of(graph: KnownGraph, name: str, method: Method, best: MethodAnswer) -> GraphVerdict:
    """One answer, judged; a method without an answer fails."""
    try:
        return judged(graph, name, method(graph), best)
    except NoAnswer as error:
        lost = f"{name}: {error}"
    right = int(np.count_nonzero(graph.is_right))
    of_oracle = judged(graph, name, best, best).oracle_m
    groups, never = graph.groups, float("inf")
    return GraphVerdict(graph.seed, name, never, of_oracle, False, 0, right, right, False, True, groups, 0.0, lost)


def read_rows(path: Path) -> list[GraphVerdict]:
    """Rows of an earlier campaign; none where there is no file."""
    if not path.exists():
        return []
    names = {field.name for field in fields(GraphVerdict)}
    lines = path.read_text(encoding="utf-8").splitlines()
    return [GraphVerdict(**{k: v for k, v in json.loads(line).items() if k in names}) for line in lines]


HEAD = (
    "| method | draws | median | 95 % | worst | failures | of those without groups | with groups "
    "| not joined | worse than odometry, unsaid | wrong kept | right lost | CPU s |"
)


def table(verdicts: Sequence[GraphVerdict]) -> str:
    """A row per method, as Markdown. Ratios are ATE over the oracle's, of those without groups where there are any."""
    names = list(dict.fromkeys(v.method for v in verdicts))
    return "\n".join(
        [HEAD, "|---" * 13 + "|", *(_row(name, [v for v in verdicts if v.method == name]) for name in names)]
    )


def _row(name: str, of_method: Sequence[GraphVerdict]) -> str:
    plain = [v for v in of_method if not v.groups]
    grouped = [v for v in of_method if v.groups]
    ratios = np.array([v.ratio for v in plain or grouped])
    unsaid = sum(v.worse_than_odometry and not v.warned for v in of_method)
    lost = sum(v.right_lost for v in of_method) / max(sum(v.right for v in of_method), 1)
    return (
        f"| {name} | {len(of_method)} | {np.median(ratios):.3f} | {np.percentile(ratios, 95):.2f} | {ratios.max():.1f} "
        f"| {_share(of_method)} | {_share(plain)} | {_share(grouped)} | {sum(not v.joined for v in of_method)} "
        f"| {unsaid} | {sum(v.wrong_kept for v in of_method)} | {lost:.2%} | {sum(v.cpu_s for v in of_method):.0f} |"
    )


def _share(verdicts: Sequence[GraphVerdict]) -> str:
    failed = sum(v.failed for v in verdicts)
    return f"{failed}/{len(verdicts)} ({failed / len(verdicts):.1%})" if verdicts else "none"
