"""Joins of two robots that are held until they meet at a second place, as the solver's warnings tell of them."""

from collections.abc import Sequence

from flocc_agent.core.tentative_joins import SECOND_PLACE
from flocc_launch.doctor.finding import Finding, blocked
from flocc_launch.runs.alike_places import ADVICE
from flocc_protocol.ids import KeyframeId


def join_held(warnings: Sequence[str], a: str, b: str) -> Finding | None:
    """What keeps two robots apart whose closures wait for a second place; None where none do."""
    held = [text.split(SECOND_PLACE) for text in warnings if SECOND_PLACE in text]
    whys = [why for closure, why in held if _robots_of(closure) == {a, b}]
    if not whys:
        return None
    return blocked(
        "join-held",
        f"{a} and {b} have met at one place only, or at two that look alike: their closures there ({len(whys)}) are "
        f"held, because {whys[0]}.",
        ADVICE,
        a,
        b,
    )


def _robots_of(closure: str) -> set[str]:
    """Robots of what begins a warning, `closure r1/3 - r2/5: `."""
    return {KeyframeId.parse(word.rstrip(":")).log.robot for word in closure.split() if "/" in word}
