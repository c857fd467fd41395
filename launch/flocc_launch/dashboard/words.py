"""Events as short sentences for people who watch."""

from flocc_agent.core.reports import (
    ClosureAccepted,
    ClosureRejected,
    ClosureWithdrawn,
    CorrectionApplied,
    EncodingFailed,
    Fact,
    LatentFailed,
    LeaderFollowed,
    LeaderLost,
    NameTaken,
    NeighbourDown,
    NeighbourUp,
    PeerRefused,
    RoundFailed,
    RoundSolved,
)
from flocc_agent.runtime.event_lines import Reported, UnknownFact
from flocc_agent.runtime.facts import AgentDied, AgentStopped


def sentence_of(event: Reported[Fact]) -> str | None:
    """What happened, seen from the event's robot; None for what happens all the time."""
    fact = event.fact
    match fact:
        case LeaderFollowed():
            return f"{'leads' if fact.leader == event.robot else f'follows {fact.leader}'}, term {fact.term}"
        case LeaderLost():
            return f"lost its leader ({fact.reason})" if fact.reason else "lost its leader"
        case NeighbourUp():
            return f"hears {fact.peer}"
        case NeighbourDown():
            return f"no longer hears {fact.peer}"
        case ClosureAccepted():
            return f"closure {fact.query} – {fact.match}, match ratio {fact.ratio:.2f}"
        case ClosureWithdrawn():
            return f"took back closure {fact.query} – {fact.match}{', registers it again' if fact.again else ''}"
        case ClosureRejected():
            return f"rejected {fact.query} – {fact.match}: {fact.reason}"
        case CorrectionApplied():
            return f"moved into {fact.map_frame}" if fact.frame_changed else None
        case RoundSolved():
            return f"round {fact.round}: {fact.keyframes} keyframes, {fact.closures_used} closures used"
        case RoundFailed():
            return f"optimisation of round {fact.round} failed: {fact.reason}"
        case AgentDied():
            return "died"
        case AgentStopped():
            return "stopped"
        case PeerRefused() | NameTaken():
            return f"refused {fact.peer}: {fact.reason}"
        case LatentFailed() | EncodingFailed():
            return f"{fact.keyframe}: {fact.reason}"
        case UnknownFact():
            return str(fact)
    return None
