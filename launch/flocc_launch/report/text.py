"""A report for the terminal: the verdict, the figures, expectations, warnings."""

from collections.abc import Iterator

from flocc_launch.report.model import Expectation, Report
from flocc_launch.report.verdict import verdict


def sentences(report: Report) -> Iterator[str]:
    """Lines that a person reads after a run."""
    yield verdict(report)
    closures = report.closures
    between = f"{closures.accepted_inter_robot} between robots"
    yield f"closures: {closures.accepted} accepted ({between}), {closures.rejected} rejected"
    yield f"joint ATE: {metres(report.ate_joint_m)}; odometry alone {metres(report.ate_joint_odometry_m)}"
    yield f"map frames: {', '.join(report.map_frames) or 'none'}"
    total = sum(report.bytes.values())
    yield f"sent: {total / 1e6:.2f} MB; leader changes: {report.leader_changes}"
    for expectation in report.expectations:
        yield expected(expectation)
    for warning in report.warnings:
        yield f"warning: {warning}"


def metres(value: float | None) -> str:
    """A length, or that it is not known."""
    return "not known" if value is None else f"{value:.3f} m"


def expected(expectation: Expectation) -> str:
    """Whether an expectation came true."""
    verdicts = {True: "met", False: "MISSED", None: "could not be measured"}
    value = "unknown" if expectation.value is None else f"{expectation.value:g}"
    return f"expected {expectation.name} {expectation.limit:g}: {value}, {verdicts[expectation.met]}"
