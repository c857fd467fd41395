"""Findings that do not concern two robots: deaths, warnings, failures, unsteady leaders."""

from collections import Counter
from collections.abc import Callable

from flocc_agent.core.reports import EncodingFailed, NameTaken, RoundSolved
from flocc_agent.runtime.event_lines import Reported, of_kind
from flocc_agent.runtime.facts import AgentDied
from flocc_launch.doctor.finding import Finding, Severity
from flocc_launch.runs.closure_table import Pair
from flocc_launch.runs.ground_truth import frame_sentences, other_clocks
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.plain_numbers import seconds
from flocc_launch.runs.timeline import deaths_unasked, how_it_died

LEADER_CHANGES_MANY = 6
CLOSURES_FEW = 3


SOLVER_ADVICE = {
    "measures lengths": "Calibrate what it takes lengths from: wheel radius, stereo baseline, camera height.",
    "held until another one agrees": "If it is right, pass the place again; if not, nothing is to be done.",
    "the distance between robots": "Let them meet side by side as well as ahead, or measure a length: fix, tag, range.",
}
"""What to do about warnings that say so."""


def deaths(loaded: LoadedRun) -> list[Finding]:
    """Agents that died; one that the scenario or an operator killed needs no advice."""
    unasked = Counter(deaths_unasked(loaded.events))
    return [
        _asked_death(event) if event.fact.scripted or not unasked[event.robot] else _death(event)
        for event in of_kind(loaded.events, AgentDied)
    ]


def _death(event: Reported[AgentDied]) -> Finding:
    sentence = f"{event.robot} died at {seconds(event.t)} ({how_it_died(event)})."
    advice = f"Read robots/{event.robot}/agent.log; start it again, it comes back with the same identity."
    return Finding("agent-died", Severity.HINDERS, sentence, advice, (event.robot,))


def _asked_death(event: Reported[AgentDied]) -> Finding:
    sentence = f"{event.robot} was killed at {seconds(event.t)}, as the scenario or an operator asked."
    return Finding("agent-killed", Severity.NOTE, sentence, "", (event.robot,))


def solver_warnings(loaded: LoadedRun) -> list[Finding]:
    """What the solver warned of last."""
    rounds = of_kind(loaded.events, RoundSolved)
    warnings = rounds[-1].fact.warnings if rounds else ()
    return [
        Finding("solver-warning", Severity.HINDERS, f"The solver warns: {text}.", _advice(text)) for text in warnings
    ]


def _advice(warning: str) -> str:
    """What to do about a warning of the solver."""
    for said, advice in SOLVER_ADVICE.items():
        if said in warning:
            return advice
    return "See docs/report.md on the pose graph; more closures from other view points make scales observable."


def encoding_failures(loaded: LoadedRun) -> list[Finding]:
    """Keyframes without descriptor or latent."""
    found: dict[str, list[Reported[EncodingFailed]]] = {}
    for event in of_kind(loaded.events, EncodingFailed):
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
        sentence = (
            f"{robot} hangs on {track.map_frame} by {len(ties)} of {accepted} accepted closures; the solver did not "
            "use the rest. One false closure misplaces it."
        )
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
    solver_warnings,
    encoding_failures,
    unsteady_leaders,
    odd_truths,
)
