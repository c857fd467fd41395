"""The chain of steps from two robots to one map, each with the finding where it failed.

A step looks at two robots and gives None where it holds. Later steps may rely on the earlier ones.
"""

from collections.abc import Callable

from flocc_agent.core.election import ANSWER_TIMEOUT_S
from flocc_agent.core.reports import LatentFailed, NameTaken, PeerRefused, RoundFailed, RoundSolved
from flocc_agent.runtime.event_lines import of_kind
from flocc_agent.runtime.facts import AgentDied
from flocc_launch.doctor.finding import ONE_WAY_ADVICE, Finding, blocked, kept_apart
from flocc_launch.doctor.held_joins import join_held
from flocc_launch.doctor.merge_evidence import (
    best_similarity,
    components_join,
    emulated_radio,
    heard_s,
    held_records,
    holds,
    last_correction_s,
    named,
    pairs_between,
)
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.plain_numbers import count_of, number, seconds
from flocc_launch.runs.run_records import setting_number
from flocc_launch.runs.timeline import End, Following, ends

HEARD_S_MIN = 5.0
EXAMPLES_MAX = 3

Step = Callable[[LoadedRun, str, str], Finding | None]


def took_no_keyframes(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """A robot without keyframes has nothing to merge."""
    without = [robot for robot in (a, b) if not len(loaded.tracks[robot])]
    if not without:
        return None
    return blocked(
        "no-keyframes",
        f"{named(without)} took no keyframe.",
        "Check that images and odometry of one clock arrive, and that the robot moves further than "
        "keyframes.distance_m or turns further than keyframes.rotation_rad.",
        *without,
    )


def share_a_name(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """Two agents under one name are ignored by everybody."""
    taken = [e.fact for e in of_kind(loaded.events, NameTaken) if e.fact.peer in (a, b)]
    if not taken or holds(loaded, a, b):
        return None
    name = taken[0].peer
    return blocked(
        "duplicate-name", f"Two agents run with the name {name}.", "Give every robot a name of its own.", name
    )


def refused(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """A peer that is refused is not heard."""
    found = [e for e in of_kind(loaded.events, PeerRefused) if {e.robot, e.fact.peer} == {a, b}]
    if not found or holds(loaded, a, b):
        return None
    event = found[-1]
    return blocked(
        "refused",
        f"{event.robot} refuses {event.fact.peer}: {event.fact.reason}.",
        "Run the same flocc version, swarm name and keys on all robots.",
        a,
        b,
    )


def never_met(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """Neither hears the other, and nobody carried records between them."""
    if heard_s(loaded, a, b) or heard_s(loaded, b, a) or holds(loaded, a, b) or pairs_between(loaded, a, b):
        return None
    alone = [robot for robot in (a, b) if not any(link.robot == robot for link in loaded.links)]
    who = f"{named(alone)} heard nobody at all" if alone else f"{a} and {b} never heard each other"
    return blocked(
        "no-peer",
        f"{who}, and no third robot carried records between them.",
        kept_apart(
            emulated_radio(loaded),
            "Check that the robots share one swarm name and network, that multicast or the listed endpoints reach the "
            "other robot, and that they come into range of each other at least once.",
        ),
        a,
        b,
    )


def heard_one_way(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """One hears the other but is not heard, and nobody carries its records to the one that is deaf."""
    one, other = heard_s(loaded, a, b), heard_s(loaded, b, a)
    if bool(one) == bool(other) or any(pair.accepted for pair in pairs_between(loaded, a, b)):
        return None
    hearing, deaf = (a, b) if one else (b, a)
    result = loaded.results.get(deaf)
    if holds(loaded, a, b) if result is None else held_records(result.logs, hearing):
        return None
    return blocked(
        "one-way-link",
        f"{hearing} hears {deaf}, but {deaf} does not hear {hearing}.",
        kept_apart(emulated_radio(loaded), ONE_WAY_ADVICE),
        a,
        b,
    )


def exchanged_no_records(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """They met, but neither holds the other's keyframes."""
    if holds(loaded, a, b) is not False or pairs_between(loaded, a, b):
        return None
    together_s = min(heard_s(loaded, a, b), heard_s(loaded, b, a))
    short = f"They heard each other for {seconds(together_s)} only. " if together_s < HEARD_S_MIN else ""
    return blocked(
        "no-descriptors",
        f"{short}{a} and {b} hold no records of each other, so no descriptors were exchanged.",
        "Let them stay in range for longer, or raise the bandwidth or lower the loss of the link.",
        a,
        b,
    )


def looked_different(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """Records met, but no two keyframes were similar enough."""
    if pairs_between(loaded, a, b):
        return None
    threshold = setting_number(loaded.run.settings, "similarity_threshold", "similarity_min")
    best = best_similarity(loaded, a, b)
    said = "" if best is None else f", the best was {best:.2f}"
    limit = "the threshold" if threshold is None else f"the threshold of {threshold:g}"
    return blocked(
        "low-similarity",
        f"No keyframe of {a} looks like one of {b}: all similarities are below {limit}{said}.",
        "If they did see the same place, lower core.place_recognition.similarity_threshold or use a stronger "
        "descriptor; else let their routes overlap.",
        a,
        b,
    )


def lacked_latents(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """Candidates wait for latents that do not come."""
    pairs = pairs_between(loaded, a, b)
    if any(pair.accepted or pair.rejected for pair in pairs):
        return None
    failed = [e.fact for e in of_kind(loaded.events, LatentFailed) if e.fact.keyframe.log.robot in (a, b)]
    if not failed:
        return None
    return blocked(
        "latents",
        f"{len(pairs)} pairs of {a} and {b} look alike, but fetching their latents failed {len(failed)} times "
        f"(last: {failed[-1].reason}).",
        "Raise the bandwidth or core.loop_closing.fetch_timeout_s, use int8 latents, or let the robots stay in range "
        "for longer.",
        a,
        b,
    )


def registered_nothing(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """Candidates were found, and nobody has registered one."""
    pairs = pairs_between(loaded, a, b)
    if any(pair.accepted or pair.rejected for pair in pairs):
        return None
    return blocked(
        "not-registered",
        f"{len(pairs)} pairs of {a} and {b} look alike, but none has been registered when the run ended.",
        "Let the run go on for longer, or give the robots more compute; see registration times in the report.",
        a,
        b,
    )


def rejected_all(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """Registrations were made and all of them refused."""
    pairs = pairs_between(loaded, a, b)
    if any(pair.accepted for pair in pairs):
        return None
    rejected = sorted((pair for pair in pairs if pair.rejected), key=lambda pair: -(pair.ratio or 0.0))
    examples = ", ".join(f"{pair.query} – {pair.match}: {number(pair.ratio)}" for pair in rejected[:EXAMPLES_MAX])
    threshold = setting_number(loaded.run.settings, "match_ratio_threshold", "match_ratio_min")
    limit = "" if threshold is None else f" below R_thr {threshold:g}"
    reasons = sorted({pair.reason for pair in rejected if pair.reason})
    return blocked(
        "registrations-rejected",
        f"All {len(rejected)} registrations between {a} and {b} were rejected ({'; '.join(reasons)}); "
        f"the best match ratios{limit} are {examples}.",
        "If these pairs do show one place, use the learned or the mast3r front end, which see further; "
        "else raise core.place_recognition.similarity_threshold to save the work.",
        a,
        b,
    )


def followed_nobody(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """Closures connect them, but nobody leads."""
    if any(following.robot in (a, b) for following in loaded.followings):
        return None
    return blocked(
        "no-leader",
        f"{a} and {b} are connected by closures, but neither ever followed a leader.",
        f"Check that heartbeats arrive both ways, and that a round trip takes less than {ANSWER_TIMEOUT_S:g} s.",
        a,
        b,
    )


def optimised_nothing(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """There was a leader, but it never solved the graph with their closure."""
    since_s = min(
        (pair.at_s for pair in pairs_between(loaded, a, b) if pair.accepted and pair.at_s is not None), default=0.0
    )
    if any(event.t >= since_s for event in of_kind(loaded.events, RoundSolved)):
        return None
    failed = of_kind(loaded.events, RoundFailed)
    if failed:
        return blocked(
            "solver-failed",
            f"Every optimisation since the first closure between {a} and {b} failed ({failed[-1].fact.reason}).",
            "Try backend.solver = 'gnc-tls' and look at the warnings of the solver.",
            a,
            b,
        )
    led = max((f for f in loaded.followings if f.robot in (a, b) and f.to_s >= since_s), key=_until, default=None)
    end = None if led is None else ends(loaded.events).get(led.leader)
    silent = "The last leader left" if led is None else f"The leader {led.leader} {_how(end)}"
    return blocked(
        "leader-silent",
        f"{silent}: nothing was optimised after the first closure between {a} and {b} at {seconds(since_s)}.",
        "Let the run go on: it ended before a round."
        if end is not None and not isinstance(end.fact, AgentDied)
        else "Look at the log of the leader; let the run go on until the others elect another one.",
        a,
        b,
    )


def _until(following: Following) -> float:
    return following.to_s


def _how(end: End | None) -> str:
    """What became of a leader."""
    if end is None:
        return "is silent"
    return "died" if isinstance(end.fact, AgentDied) else f"was stopped at {seconds(end.t)}"


def held_join(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """The closures between them are of one place, and what is beside it says that it may be another one."""
    last = of_kind(loaded.events, RoundSolved)[-1].fact
    return None if components_join(last.components, a, b) else join_held(last.warnings, a, b)


def solver_dropped_closures(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """The solver had the closures and used none of them."""
    last = of_kind(loaded.events, RoundSolved)[-1].fact
    count = sum(pair.accepted for pair in pairs_between(loaded, a, b))
    joined = components_join(last.components, a, b)
    if joined or (joined is None and last.closures_used != 0):
        return None
    return blocked(
        "closures-not-connecting",
        f"{count} closures between {a} and {b} were accepted, but the optimisation of round {last.round} kept them in "
        f"separate parts ({count_of(last.closures_used)} closures used, {count_of(last.closures_rejected)} rejected).",
        "The closures contradict each other or odometry: check the camera's intrinsics and T_body_camera, and that "
        "odometry is metric.",
        a,
        b,
    )


def lost_corrections(loaded: LoadedRun, a: str, b: str) -> Finding | None:
    """The leader joined them, but a robot never heard of it."""
    last = of_kind(loaded.events, RoundSolved)[-1]
    late = [robot for robot in (a, b) if last_correction_s(loaded, robot) < last.t]
    if not late:
        return None
    return blocked(
        "corrections-lost",
        f"{last.robot} joined {a} and {b} in one map at {seconds(last.t)}, but {named(late)} applied no correction "
        "since.",
        f"Bring {named(late)} back into range of any robot of the group; corrections are passed on.",
        a,
        b,
    )


STEPS: tuple[Step, ...] = (
    took_no_keyframes,
    share_a_name,
    refused,
    never_met,
    heard_one_way,
    exchanged_no_records,
    looked_different,
    lacked_latents,
    registered_nothing,
    rejected_all,
    followed_nobody,
    optimised_nothing,
    held_join,
    solver_dropped_closures,
    lost_corrections,
)
