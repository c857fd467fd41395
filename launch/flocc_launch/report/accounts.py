"""The account of a run: bytes on every link as both of its ends counted them, and time by stage.

Each robot's `account` lines are cumulative since its start (`since_s`); a robot that was started again began anew, so
the last line of each start counts, and starts add up.
"""

from collections import Counter
from collections.abc import Iterable, Mapping

from flocc_agent.core.reports import Fact
from flocc_agent.runtime.event_lines import Reported, of_kind
from flocc_agent.runtime.facts import AccountKept
from flocc_agent.stages import BOUNDS_S, Histogram, StageCounts
from flocc_launch.report.model import KindBytes, LinkBytes, StageTime

Cell = tuple[str, str, str]
"""Sender, receiver, kind."""


def last_accounts(events: Iterable[Reported[Fact]]) -> list[Reported[AccountKept]]:
    """The last account of each start of each robot."""
    last: dict[tuple[str, float], Reported[AccountKept]] = {}
    for event in of_kind(events, AccountKept):
        last[event.robot, event.fact.since_s] = event
    return [last[key] for key in sorted(last)]


def links_of(events: Iterable[Reported[Fact]]) -> list[LinkBytes]:
    """Every link that anybody used, by sender and receiver."""
    accounts = last_accounts(events)
    kept = {account.robot for account in accounts}
    sent: Counter[Cell] = Counter()
    received: Counter[Cell] = Counter()
    lost: Counter[Cell] = Counter()
    repeated: Counter[Cell] = Counter()
    for account in accounts:
        me, kept_of = account.robot, account.fact
        for peer, kinds in kept_of.sent_to.items():
            sent.update({(me, peer, kind): count for kind, count in kinds.items()})
        tables = ((kept_of.received_from, received), (kept_of.lost_from, lost), (kept_of.repeated_from, repeated))
        for table, counted in tables:
            for peer, kinds in table.items():
                counted.update({(peer, me, kind): count for kind, count in kinds.items()})
    cells = {*sent, *received, *lost}
    return [
        _link(
            ends, sorted(kind for *link, kind in cells if tuple(link) == ends), kept, (sent, received, lost, repeated)
        )
        for ends in sorted({(sender, receiver) for sender, receiver, _ in cells})
    ]


def _link(ends: tuple[str, str], kinds: list[str], kept: set[str], counted: tuple[Counter[Cell], ...]) -> LinkBytes:
    """One link; what an end counted that left no account is not known."""
    sent, received, lost, repeated = ({kind: table[*ends, kind] for kind in kinds} for table in counted)
    sender_kept, receiver_kept = ends[0] in kept, ends[1] in kept
    unaccounted = sum(sent.values()) + sum(repeated.values()) - sum(received.values()) - sum(lost.values())
    return LinkBytes(
        sender=ends[0],
        receiver=ends[1],
        sent=sum(sent.values()) if sender_kept else None,
        received=sum(received.values()) if receiver_kept else None,
        lost=sum(lost.values()) if receiver_kept else None,
        repeated=sum(repeated.values()) if receiver_kept else None,
        unaccounted=unaccounted if sender_kept and receiver_kept else None,
        by_kind={
            kind: KindBytes(
                sent=sent[kind] if sender_kept else None, received=received[kind] if receiver_kept else None
            )
            for kind in kinds
        },
    )


def stages_by_robot(events: Iterable[Reported[Fact]]) -> dict[str, dict[str, StageTime]]:
    """Time by stage of each robot, over all its starts."""
    merged: dict[str, dict[str, Histogram]] = {}
    for account in last_accounts(events):
        _merge(merged.setdefault(account.robot, {}), account.fact.stages)
    return {robot: {stage: stage_time(h) for stage, h in sorted(stages.items())} for robot, stages in merged.items()}


def stages_of(events: Iterable[Reported[Fact]]) -> dict[str, StageTime]:
    """Time by stage of all robots together."""
    merged: dict[str, Histogram] = {}
    for account in last_accounts(events):
        _merge(merged, account.fact.stages)
    return {stage: stage_time(h) for stage, h in sorted(merged.items())}


def _merge(into: dict[str, Histogram], stages: Mapping[str, StageCounts]) -> None:
    for stage, times in stages.items():
        if len(times.counts) == len(BOUNDS_S) + 1:
            into.setdefault(stage, Histogram()).add(times.counts, times.total_s, times.max_s)


def stage_time(histogram: Histogram) -> StageTime:
    """A histogram with what one reads off it."""
    return StageTime(
        count=histogram.count,
        total_s=histogram.total_s,
        median_s=histogram.quantile_s(0.5),
        p90_s=histogram.quantile_s(0.9),
        max_s=histogram.max_s,
        counts=histogram.counts,
    )
