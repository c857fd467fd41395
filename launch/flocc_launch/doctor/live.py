"""Findings of a swarm that runs, from what its agents answer."""

from collections.abc import Sequence
from dataclasses import replace

from flocc_agent.core.reports import CAME_APART
from flocc_launch.dashboard.status_table import NO_ANSWER, RobotStatus
from flocc_launch.doctor.cameras import doubts_told, finding_of, findings_of, merged_doubtfully
from flocc_launch.doctor.finding import (
    APART_ADVICE,
    ONE_WAY_ADVICE,
    Finding,
    Severity,
    blocked,
    kept_apart,
    together,
)
from flocc_launch.doctor.live_steps import apart, is_server
from flocc_launch.doctor.merge_evidence import named


def diagnose_live(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Say why the maps of a running swarm have or have not merged, as far as its agents' states show."""
    silent = [row.robot for row in rows if row.state == NO_ANSWER]
    return [*_answered([row for row in rows if row.robot not in silent]), *late(silent)]


def late(silent: Sequence[str]) -> list[Finding]:
    """Robots that are there and did not answer in time."""
    if not silent:
        return []
    sentence = f"{named(silent)} did not answer in time, asked twice, so nothing more is said of them."
    advice = "A machine under load answers late: give a longer --timeout."
    return [Finding("no-answer", Severity.NOTE, sentence, advice, tuple(silent))]


def _answered(rows: Sequence[RobotStatus]) -> list[Finding]:
    checks = (shared, lonely, unheard, without_keyframes, leaderless, refusing, coming_apart)
    found = [finding for check in checks for finding in check(rows)]
    cameras = findings_of(doubts_told(rows))
    first = merging(rows, any(finding.cause != "refused" for finding in found))
    if any(finding.cause == "merged" for finding in first):
        found = [replace(finding, severity=Severity.HINDERS) for finding in found]
    return together([*first, *found, *cameras])


def merging(rows: Sequence[RobotStatus], explained: bool) -> list[Finding]:
    """Whether all that answered share one map."""
    moving = [row for row in rows if not is_server(row)]
    frames = sorted({row.map_frame for row in moving if row.map_frame is not None})
    if len(moving) > 1 and len(frames) == 1 and all(row.map_frame for row in moving):
        robots = tuple(row.robot for row in moving)
        sentence = f"All {len(moving)} robots that answered are in {frames[0]}."
        misplaced = [doubt for doubt in doubts_told(moving) if doubt.withheld]
        if misplaced:
            return [merged_doubtfully(sentence, misplaced)]
        return [Finding("merged", Severity.GOOD, sentence, "", robots)]
    if explained or len(rows) < 2:
        return []
    blocking = [finding_of(doubt, Severity.BLOCKS) for doubt in doubts_told(moving) if doubt.withheld]
    return blocking or apart(rows) or [not_merged_yet(rows, len(frames))]


def not_merged_yet(rows: Sequence[RobotStatus], maps: int) -> Finding:
    """All is as it should be, but for the map."""
    closures = max(row.closures or 0 for row in rows)
    sentence = f"{maps} maps, {closures} closures known so far, and all robots hear and follow each other."
    advice = "Give it time; once the run is over, flocc doctor on its run folder names the step that failed."
    return Finding("not-merged-yet", Severity.NOTE, sentence, advice)


def shared(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Names under which two robots run, a copied disk most often; only one of them answers for both."""
    advice = "Give every robot a name and a folder of its own; a copied disk (SD card) carries both along."
    return [
        blocked("duplicate-name", f"Two agents run with the name {name}, as {named(heard)} heard.", advice, name)
        for name in sorted({name for row in rows for name in row.doubles})
        for heard in [[row.robot for row in rows if name in row.doubles]]
    ]


def lonely(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Robots that hear nobody, and whom nobody hears."""
    heard = {peer for row in rows for peer in row.neighbours}
    alone = [row.robot for row in rows if not row.neighbours and row.robot not in heard]
    if not alone or len(rows) < 2:
        return []
    return [
        blocked(
            "no-peer",
            f"{named(alone)} hear{'s' * (len(alone) == 1)} no other robot.",
            kept_apart(
                emulated_of(rows),
                "Check range, multicast or the roster's endpoints, and that all run one version and one swarm name.",
            ),
            *alone,
        )
    ]


def unheard(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Links that work in one direction only."""
    hears = {row.robot: set(row.neighbours) for row in rows}
    return [
        blocked(
            "one-way-link",
            f"{a} hears {b}, but {b} does not hear {a}.",
            kept_apart(emulated_of(rows), ONE_WAY_ADVICE),
            a,
            b,
        )
        for a in sorted(hears)
        for b in sorted(hears[a])
        if b in hears and a not in hears[b]
    ]


def emulated_of(rows: Sequence[RobotStatus]) -> str | None:
    """What of the radio is emulated, as the first robot says that has any of it emulated."""
    return next((row.emulated for row in rows if row.emulated is not None), None)


def without_keyframes(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Robots that took no keyframe."""
    empty = [row.robot for row in rows if row.keyframes == 0 and not is_server(row)]
    advice = "Check that images and odometry of one clock arrive and that the robot moves; see keyframes.distance_m."
    return [blocked("no-keyframes", f"{named(empty)} took no keyframe.", advice, *empty)] if empty else []


def leaderless(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Robots that follow nobody, and robots in range of each other that follow different leaders."""
    nobody = [row.robot for row in rows if row.leader is None]
    found = []
    if nobody:
        advice = "An election takes a few seconds; if it does not end, heartbeats get lost: see the loss of links."
        found.append(
            blocked("no-leader", f"{named(nobody)} follow{'s' * (len(nobody) == 1)} no leader.", advice, *nobody)
        )
    leader = {row.robot: row.leader for row in rows}
    for row in rows:
        for peer in row.neighbours:
            if row.robot < peer and leader.get(peer) not in (None, row.leader) and row.leader is not None:
                sentence = f"{row.robot} and {peer} hear each other but follow {row.leader} and {leader[peer]}."
                advice = "Two groups that just met agree within seconds; if they do not, look for one-way links."
                found.append(Finding("two-leaders", Severity.HINDERS, sentence, advice, (row.robot, peer)))
    return found


def refusing(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Robots that drop or refuse messages."""
    return [
        Finding(
            "refused",
            Severity.HINDERS,
            f"{row.robot} dropped or refused messages: "
            + ", ".join(f"{count} × {reason}" for reason, count in sorted(refused.items()))
            + ".",
            "Run one flocc version with the same keys on all robots; drops alone mean more load than it can take.",
            (row.robot,),
        )
        for row in rows
        if (refused := {reason: n for reason, n in row.refused.items() if not reason.endswith(CAME_APART)})
    ]


def coming_apart(rows: Sequence[RobotStatus]) -> list[Finding]:
    """Robots in distributed mode whose exchange led away from each other."""
    told = [(row.robot, n) for row in rows for reason, n in row.refused.items() if reason.endswith(CAME_APART)]
    return [
        Finding(
            "came-apart",
            Severity.HINDERS,
            f"{robot} came apart from others {count} times, went back to where they agreed and does not hear them now.",
            APART_ADVICE,
            (robot,),
        )
        for robot, count in told
    ]
