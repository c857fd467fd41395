"""Findings that do not concern two robots: deaths, warnings, failures, unsteady leaders."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from statistics import median

from flocc_agent.core.reports import (
    CAME_APART,
    WITHHELD,
    EncodingFailed,
    FrontEndsDiffer,
    NameTaken,
    PeerRefused,
    RoundSolved,
)
from flocc_agent.core.tentative_joins import SECOND_PLACE
from flocc_agent.runtime.event_lines import Reported, of_kind
from flocc_agent.runtime.facts import AgentDied
from flocc_launch.doctor.cameras import doubted_cameras
from flocc_launch.doctor.finding import APART_ADVICE, Finding, Severity
from flocc_launch.doctor.odometry_up import odd_up
from flocc_launch.runs.alike_places import ADVICE
from flocc_launch.runs.closure_table import Pair
from flocc_launch.runs.ground_truth import frame_sentences, other_clocks
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.plain_numbers import seconds
from flocc_launch.runs.right_closures import verdicts
from flocc_launch.runs.timeline import deaths_unasked, how_it_died

LEADER_CHANGES_MANY = 6
CLOSURES_FEW = 3
REFUSED_MIN = 4
CLOCKS_APART = "pictures and odometry are on clocks that differ (flocc dataset clock measures by how much)"
CLOSURES_WRONG = (
    "places that look alike are taken for one (look at the pictures in the report, then raise "
    "core.loop_closing.match_ratio_threshold or use the learned front end)",
    "the camera's intrinsics or T_body_camera are wrong",
    "odometry is not metric, or jumps",
    CLOCKS_APART,
)
MEASURED_WRONG = (
    "the camera's intrinsics or T_body_camera are wrong",
    "odometry is not metric, or jumps",
    CLOCKS_APART,
    "places that look alike are taken for one (look at the pictures in the report)",
)
REASONS_LEFT = (
    "odometry drifts more than backend.odometry_translation_sigma_m and backend.odometry_rotation_sigma_rad say",
)


SOLVER_ADVICE = {
    "not along the way": "Look at odometry there first: wheels that slipped, a push, a robot that was blocked.",
    "measures lengths": "Calibrate what it takes lengths from: wheel radius, stereo baseline, camera height.",
    SECOND_PLACE: ADVICE,
    "held until another one agrees": "If it is right, pass the place again; if not, nothing is to be done.",
    "sightings that agree": "One alone may be wrong: see it a second time, or set backend.closures_to_join_min = 1.",
    "agree with the rest of the map": "docs/measurements.md says how each kind is written.",
    "nothing measured ties": "Do not believe where that part is: pass a place that was seen before, or a tag.",
    "look the same": "Look at the pictures of both places in the report; a fix, a tag or a known start decides.",
    "the distance between robots": "Let them meet side by side as well as ahead, or measure a length: fix, tag, range.",
}
"""What to do about warnings that say so."""


def deaths(loaded: LoadedRun) -> list[Finding]:
    """Agents that died; one that the scenario or an operator killed needs no advice."""
    unasked = Counter(deaths_unasked(loaded.events))
    return [
        _asked_death(event) if event.fact.scripted or not unasked[event.robot] else _death(loaded, event)
        for event in of_kind(loaded.events, AgentDied)
    ]


def _death(loaded: LoadedRun, event: Reported[AgentDied]) -> Finding:
    sentence = f"{event.robot} died at {seconds(event.t)} ({how_it_died(event)})."
    read = "" if loaded.run.driver == "simulate" else f"Read robots/{event.robot}/agent.log. "
    advice = f"{read}An agent that is started again comes back with the same identity."
    return Finding("agent-died", Severity.HINDERS, sentence, advice, (event.robot,))


def _asked_death(event: Reported[AgentDied]) -> Finding:
    sentence = f"{event.robot} was killed at {seconds(event.t)}, as the scenario or an operator asked."
    return Finding("agent-killed", Severity.NOTE, sentence, "", (event.robot,))


def solver_warnings(loaded: LoadedRun) -> list[Finding]:
    """What the solver warned of last; of warnings that differ in names and numbers only, one."""
    rounds = of_kind(loaded.events, RoundSolved)
    alike: dict[str, list[str]] = {}
    for text in rounds[-1].fact.warnings if rounds else ():
        alike.setdefault(re.sub(r"\S*\d\S*", "#", text), []).append(text.rstrip("."))
    return [Finding("solver-warning", Severity.HINDERS, _warned(texts), _advice(texts[0])) for texts in alike.values()]


def _warned(texts: Sequence[str]) -> str:
    more = f" (the first of {len(texts)} such warnings)" if len(texts) > 1 else ""
    return f"The solver warns: {texts[0]}{more}."


def _advice(warning: str) -> str:
    """What to do about a warning of the solver."""
    for said, advice in SOLVER_ADVICE.items():
        if said in warning:
            return advice
    return "See docs/back-end.md; more closures from other view points make scales observable."


def solver_refusals(loaded: LoadedRun) -> list[Finding]:
    """A solver that leaves out over half of the closures it was given."""
    rounds = of_kind(loaded.events, RoundSolved)
    used, refused = (rounds[-1].fact.closures_used, rounds[-1].fact.closures_rejected) if rounds else (None, None)
    if used is None or refused is None or refused < REFUSED_MIN or refused <= used:
        return []
    right = Counter(verdicts(loaded)[pair.query, pair.match] for pair in left_out(loaded))
    told = f" By ground truth {right[True]} of {right.total()} of these are right." if right else ""
    sentence = f"The solver left out {refused} of {used + refused} accepted closures.{told}"
    few = CLOSURES_WRONG if right[False] > right[True] or (not right and look_weak(loaded)) else MEASURED_WRONG
    advice = f"Likely reasons, in this order: {'; '.join((*few, *REASONS_LEFT))}."
    return [Finding("solver-refuses", Severity.HINDERS, sentence, advice)]


def comings_apart(loaded: LoadedRun) -> list[Finding]:
    """Robots in distributed mode whose exchange led away from each other."""
    found = [event for event in of_kind(loaded.events, PeerRefused) if event.fact.reason.endswith(CAME_APART)]
    told = Counter((event.robot, event.fact.peer) for event in found)
    return [
        Finding(
            "came-apart",
            Severity.HINDERS,
            f"{robot} came apart from {peer} {count} times, went back to where both agreed and was deaf to it a while.",
            APART_ADVICE,
            (robot, peer),
        )
        for (robot, peer), count in sorted(told.items())
    ]


def left_out(loaded: LoadedRun) -> list[Pair]:
    """Accepted pairs that the last solution did not use, and that ground truth can judge."""
    known = verdicts(loaded)
    return [pair for pair in loaded.pairs if pair.used is False and (pair.query, pair.match) in known]


def look_weak(loaded: LoadedRun) -> bool:
    """Whether the closures that were left out have lower match ratios than those that were used."""
    ratios: dict[bool, list[float]] = {True: [], False: []}
    for pair in loaded.pairs:
        if pair.used is not None and pair.ratio is not None:
            ratios[pair.used].append(pair.ratio)
    return bool(ratios[True] and ratios[False]) and median(ratios[False]) < 0.5 * median(ratios[True])


def encoding_failures(loaded: LoadedRun) -> list[Finding]:
    """Keyframes without descriptor or latent, but for those that were kept out: of these the camera's finding tells."""
    found: dict[str, list[Reported[EncodingFailed]]] = {}
    for event in of_kind(loaded.events, EncodingFailed):
        if event.fact.reason != WITHHELD:
            found.setdefault(event.robot, []).append(event)
    return [
        Finding(
            "encoding-failed",
            Severity.HINDERS,
            f"{len(events)} keyframes of {robot} could not be encoded (last: {events[-1].fact.reason}).",
            "Check the images, and the checkpoints of the perception back-end.",
            (robot,),
        )
        for robot, events in sorted(found.items())
    ]


def unsteady_leaders(loaded: LoadedRun) -> list[Finding]:
    """Leaders that change all the time."""
    findings = []
    for robot in loaded.robots:
        mine = [following for following in loaded.followings if following.robot == robot]
        if len(mine) > LEADER_CHANGES_MANY:
            sentence = f"{robot} followed {len(mine)} leaders in {seconds(loaded.end_s)}."
            advice = "Links flap or heartbeats come late: raise core.election.leader_timeout_s, or lower the load."
            findings.append(Finding("unsteady-leader", Severity.HINDERS, sentence, advice, (robot,)))
    return findings


def shared_names(loaded: LoadedRun) -> list[Finding]:
    """Names that two agents run with."""
    names = sorted({event.fact.peer for event in of_kind(loaded.events, NameTaken)})
    return [
        Finding(
            "duplicate-name",
            Severity.HINDERS,
            f"Two agents run with the name {name}.",
            "Give every robot a name of its own.",
            (name,),
        )
        for name in names
    ]


def front_ends(loaded: LoadedRun) -> list[Finding]:
    """Robots that see with different methods, models or weights."""
    told = of_kind(loaded.events, FrontEndsDiffer)
    return [
        Finding(
            "front-ends-differ",
            Severity.HINDERS,
            f"{first} and {second} run different front ends, so their latents cannot be registered with each other.",
            "Give all robots one perception.method with one model and the same weights.",
            (first, second),
        )
        for first, second in sorted({(min(e.robot, e.fact.peer), max(e.robot, e.fact.peer)) for e in told})
    ]


def weak_links(loaded: LoadedRun) -> list[Finding]:
    """Robots that hang on their common map by so few closures that one false one misplaces them."""
    used = [robots_of(pair) for pair in loaded.pairs if pair.used]
    findings = []
    for robot, track in loaded.tracks.items():
        others = {name for name, other in loaded.tracks.items() if other.map_frame == track.map_frame} - {robot}
        ties = [ends for ends in used if robot in ends and ends - {robot} <= others and len(ends) == 2]
        if track.map_frame is None or not others or not 0 < len(ties) < CLOSURES_FEW:
            continue
        accepted = sum(pair.accepted and robot in robots_of(pair) and pair.inter_robot for pair in loaded.pairs)
        closures = "closure" if len(ties) == 1 else "closures"
        counted = f"{len(ties)} {closures}, all that were accepted"
        if accepted > len(ties):
            counted = f"{len(ties)} of {accepted} accepted closures; the solver did not use the rest"
        sentence = f"{robot} hangs on {track.map_frame} by {counted}. One false closure misplaces it."
        advice = "Let it meet the others again, or use a front end that sees further (perception.method = 'learned')."
        findings.append(Finding("weak-link", Severity.HINDERS, sentence, advice, (robot,)))
    return findings


def odd_truths(loaded: LoadedRun) -> list[Finding]:
    """Ground truth on another clock, or in frames of its own."""
    clock = "Shift its stamps by that, or put a file with the right ones into groundtruth/ of the run."
    frame = "Look at the map in the report; put truths of one frame into groundtruth/ of the run and evaluate it again."
    return [
        *(Finding("truth-clock", Severity.HINDERS, sentence, clock) for sentence in other_clocks(loaded.tracks)),
        *(Finding("truth-frames", Severity.HINDERS, sentence, frame) for sentence in frame_sentences(loaded.tracks)),
    ]


def robots_of(pair: Pair) -> set[str]:
    """The two robots of a pair."""
    return {pair.query.log.robot, pair.match.log.robot}


GENERAL: tuple[Callable[[LoadedRun], list[Finding]], ...] = (
    deaths,
    shared_names,
    weak_links,
    front_ends,
    doubted_cameras,
    solver_warnings,
    solver_refusals,
    comings_apart,
    encoding_failures,
    unsteady_leaders,
    odd_truths,
    odd_up,
)
