"""`flocc evaluate`: a run's figures as lines of text."""

from pathlib import Path

from flocc_launch.evaluation import EvaluationError, evo_ape
from flocc_launch.report.finish import finish
from flocc_launch.report.model import Report
from flocc_launch.report.svg import count_of, number, seconds, size_of
from flocc_launch.report.verdict import verdict
from flocc_launch.run_folder import RunFolder


def evaluate(path: Path, with_evo: bool = False) -> tuple[Report, list[str]]:
    """Compute a run's report anew, write it into the run folder, and say what it comes to.

    Args:
        path: The run folder.
        with_evo: Let evo compute each robot's ATE as well, where the user installed it.

    Returns:
        The report, and lines for a terminal.

    Raises:
        RunFolderError: The folder is not that of a run, or it is cut off.
        EvaluationError: evo is asked for and not installed, or no robot has ground truth.
    """
    report = finish(RunFolder.open(path))
    lines = summary(report)
    return report, [*lines, *evo_lines(path, report)] if with_evo else lines


def summary(report: Report) -> list[str]:
    """The figures of a report, one per line."""
    closures, bytes_sent = report.closures, sum(report.bytes.values())
    lines = [
        verdict(report),
        "",
        f"map frames    {', '.join(report.map_frames) or 'none'}",
        f"merged after  {seconds(report.merged_after_s)}",
        f"closures      {count_of(closures.accepted)} accepted ({count_of(closures.accepted_inter_robot)} between "
        f"robots), {count_of(closures.rejected)} rejected of {count_of(closures.candidates)} candidates",
        f"joint ATE     {number(report.ate_joint_m, 'm')}; odometry at its true starts "
        f"{number(report.ate_joint_odometry_m, 'm')}, aligned {number(report.ate_joint_odometry_aligned_m, 'm')}",
        f"sent          {size_of(bytes_sent) if report.bytes else '–'}"
        + "".join(f", {kind} {size_of(n)}" for kind, n in sorted(report.bytes.items(), key=lambda item: -item[1])),
        f"leaders       {', '.join(f'{span.leader} (term {span.term})' for span in report.leaders) or 'none'}",
        "",
        *robot_lines(report),
    ]
    lines += [
        f"expected      {e.name} {number(e.limit)}: {number(e.value)}, {judged(e.met)}" for e in report.expectations
    ]
    return lines + [f"note          {warning}" for warning in report.warnings]


def judged(met: bool | None) -> str:
    """What became of an expectation."""
    return "not measured" if met is None else "met" if met else "MISSED"


def robot_lines(report: Report) -> list[str]:
    """A table of robots."""
    head = f"{'robot':<14}{'keyframes':>10}{'ATE, m':>10}{'odometry':>10}{'RPE, m':>10}{'odometry':>10}  map frame"
    rows = [
        f"{robot.robot:<14}{robot.keyframes:>10}{number(robot.corrected.ate_m):>10}{number(robot.odometry.ate_m):>10}"
        f"{number(robot.corrected.rpe_translation_m):>10}{number(robot.odometry.rpe_translation_m):>10}"
        f"  {robot.map_frame or '–'}"
        for robot in report.robot_details
    ]
    return [head, *rows, ""]


def evo_lines(path: Path, report: Report) -> list[str]:
    """What evo says of every robot that has ground truth."""
    lines = []
    for robot in report.robots:
        truth, estimate = path / "groundtruth" / f"{robot}.tum", path / "trajectories" / f"{robot}.tum"
        if truth.exists() and estimate.exists():
            lines += [f"evo_ape, {robot}", *evo_ape(truth, estimate).splitlines()]
    if not lines:
        raise EvaluationError(f"{path}: no robot has both ground truth and a corrected trajectory for evo")
    return lines
