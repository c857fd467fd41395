"""Events as short sentences for people who watch."""

from flocc_launch.runs.run_records import (
    AgentDied,
    AgentStopped,
    ClosureAccepted,
    ClosureRejected,
    CorrectionApplied,
    EncodingFailed,
    Event,
    GraphOptimised,
    LatentFailed,
    LeaderFollowed,
    LeaderLost,
    NameTaken,
    NeighbourDown,
    NeighbourUp,
    OptimisationFailed,
    PeerRefused,
)


def sentence_of(event: Event) -> str | None:
    """What happened, seen from the event's robot; None for what happens all the time."""
    match event:
        case LeaderFollowed():
            who = "leads" if event.leader == event.robot else f"follows {event.leader}"
            return f"{who}, term {event.term}" if event.leader is not None else "follows nobody"
        case LeaderLost():
            return f"lost its leader ({event.reason})" if event.reason else "lost its leader"
        case NeighbourUp():
            return f"hears {event.peer}"
        case NeighbourDown():
            return f"no longer hears {event.peer}"
        case ClosureAccepted():
            return f"closure {event.query} – {event.match}, match ratio {event.ratio:.2f}"
        case ClosureRejected():
            return f"rejected {event.query} – {event.match}: {event.reason}"
        case CorrectionApplied():
            return f"moved into {event.map_frame}" if event.frame_changed else None
        case GraphOptimised():
            return f"optimised round {event.round}: {event.keyframes} keyframes, {event.closures_used} closures"
        case OptimisationFailed():
            return f"optimisation of round {event.round} failed: {event.reason}"
        case AgentDied():
            return "died"
        case AgentStopped():
            return "stopped"
        case PeerRefused() | NameTaken():
            return f"refused {event.peer}: {event.reason}"
        case LatentFailed() | EncodingFailed():
            return f"{event.keyframe}: {event.reason}"
    return None
