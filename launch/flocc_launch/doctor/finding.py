"""What the doctor says."""

from dataclasses import dataclass
from enum import Enum


class Severity(Enum):
    """How much a finding matters."""

    GOOD = "good"
    BLOCKS = "blocks merging"
    HINDERS = "hinders"
    NOTE = "worth knowing"


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence of the doctor.

    Attributes:
        cause: Name of the cause, for programs.
        severity: How much it matters.
        sentence: What was found, with the figures that show it.
        advice: What to change; empty where nothing needs to.
        robots: Whom it concerns.
    """

    cause: str
    severity: Severity
    sentence: str
    advice: str = ""
    robots: tuple[str, ...] = ()


def blocked(cause: str, sentence: str, advice: str, *robots: str) -> Finding:
    """A finding that blocks merging."""
    return Finding(cause, Severity.BLOCKS, sentence, advice, robots)
