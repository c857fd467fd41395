"""What the doctor says."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

APART_ADVICE = (
    "Look for closures of theirs that are wrong, and for odometry whose covariances say too little; "
    "backend.mode central has a leader solve instead."
)
ONE_WAY_ADVICE = "Look for a firewall or an endpoint that only one side can reach, and for unequal transmit power."


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


def finding_lines(findings: Iterable[Finding]) -> list[str]:
    """Findings as lines for a terminal, advice below each."""
    marks = {Severity.GOOD: "ok  ", Severity.BLOCKS: "FAIL", Severity.HINDERS: "warn", Severity.NOTE: "note"}
    lines = []
    for finding in findings:
        lines.append(f"{marks[finding.severity]}  {finding.sentence}")
        lines += [f"      {finding.advice}"] if finding.advice else []
    return lines


def blocked(cause: str, sentence: str, advice: str, *robots: str) -> Finding:
    """A finding that blocks merging."""
    return Finding(cause, Severity.BLOCKS, sentence, advice, robots)


def good(cause: str, sentence: str) -> Finding:
    """A finding that all is well."""
    return Finding(cause, Severity.GOOD, sentence)


def together(findings: Iterable[Finding]) -> list[Finding]:
    """Findings with equal sentences become one, as severe as the first."""
    found: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        key = (finding.cause, finding.sentence)
        known = found.get(key)
        robots = finding.robots if known is None else tuple(sorted({*known.robots, *finding.robots}))
        found[key] = replace(known or finding, robots=robots)
    return list(found.values())


def kept_apart(emulated: str | None, advice: str) -> str:
    """What to do where robots do not hear each other: advice on the network, after what is emulated of the radio."""
    if emulated is None:
        return advice
    return (
        f"The emulated radio may be why ({emulated}): change [radio], or what the scenario's faults do to it. "
        f"If it is not: {advice[0].lower()}{advice[1:]}"
    )
