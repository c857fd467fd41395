"""A report for the terminal: the verdict, the figures, expectations, warnings."""

from flocc_launch.report.model import RobotReport, RunReport
from flocc_launch.report.verdict import verdict
from flocc_launch.runs.plain_numbers import count_of, number, plain, seconds, size_of

MISSED = "MISSED: "
"""How the first line begins where an expectation was missed."""


def short_sentences(report: RunReport) -> list[str]:
    """What was missed, and the verdict."""
    return [*missed_lines(report), verdict(report)]


def sentences(report: RunReport, verbose: bool = False) -> list[str]:
    """Lines that a person reads after a run: what was missed, the verdict, the figures, the robots, expectations.

    Args:
        report: The run's.
        verbose: Say bytes by kind and times by stage as well.
    """
    closures, bytes_sent = report.closures, sum(report.bytes.values())
    lines = [
        *short_sentences(report),
        "",
        f"map frames    {', '.join(report.map_frames) or 'none'}",
        f"merged after  {seconds(report.merged_after_s)}",
        f"closures      {count_of(closures.accepted)} accepted ({count_of(closures.accepted_inter_robot)} between "
        f"robots), {count_of(closures.rejected)} rejected of {count_of(closures.candidates)} candidates",
        *error_lines(report),
        f"sent          {size_of(bytes_sent) if report.bytes else '–'}"
        + "".join(f", {kind} {size_of(n)}" for kind, n in by_size(report) if verbose),
        f"leaders       {', '.join(f'{span.leader} (term {span.term})' for span in report.leaders) or 'none'}",
        "",
        *robot_lines(report),
        *(stage_lines(report) if verbose else ()),
    ]
    lines += [
        f"expected      {e.name} {plain(e.limit)}: {plain(e.value)}, {judged(e.met)}" for e in report.expectations
    ]
    return lines + [f"note          {warning}" for warning in report.warnings]


def error_lines(report: RunReport) -> list[str]:
    """Errors of all robots together; nothing where there is no ground truth, which the verdict says."""
    lines = []
    if any(e is not None for e in (report.ate_joint_m, report.ate_joint_odometry_m, *report.ate_dead_m.values())):
        lines.append(
            f"joint ATE     {number(report.ate_joint_m, 'm')}{of_the_dead(report)}; odometry at its true starts "
            f"{number(report.ate_joint_odometry_m, 'm')}, aligned {number(report.ate_joint_odometry_aligned_m, 'm')}"
        )
    during = [] if report.if1 is None else [f"F1 of closures {number(report.if1)}"]
    if report.iate_m is not None:
        rounds = f"mean of {count_of(report.iate_moments)} rounds in one map"
        errors = f"ATE {number(report.iate_m, 'm')}; odometry {number(report.iate_odometry_m, 'm')}"
        during.insert(0, f"{errors} ({rounds})")
    if during:
        lines.append(f"during it     {'; '.join(during)}")
    return lines


def by_size(report: RunReport) -> list[tuple[str, int]]:
    """Kinds of messages with their bytes, the largest first."""
    return sorted(report.bytes.items(), key=lambda item: -item[1])


def missed_lines(report: RunReport) -> list[str]:
    """One line of the expectations that were missed or not measured; none where all were met."""
    missed = [e for e in report.expectations if e.met is not True]
    told = [f"{e.name} {plain(e.limit)} ({plain(e.value) if e.met is False else 'not measured'})" for e in missed]
    return [f"{MISSED}{', '.join(told)}"] if told else []


def of_the_dead(report: RunReport) -> str:
    """That the joint error is of the survivors, and how far off the others were until they died."""
    if all(robot.end != "died" for robot in report.robot_details):
        return ""
    dead = (f", {robot} until it died {number(error_m, 'm')}" for robot, error_m in sorted(report.ate_dead_m.items()))
    whose = " of the survivors" if report.ate_joint_m is not None else ", as the survivors have no map together"
    return f"{whose}{''.join(dead)}"


def judged(met: bool | None) -> str:
    """What became of an expectation."""
    return "not measured" if met is None else "met" if met else "MISSED"


def stage_lines(report: RunReport) -> list[str]:
    """A table of stages, where the run kept account of them."""
    if not report.stages:
        return []
    head = f"{'stage':<14}{'count':>10}{'median, s':>11}{'90 %, s':>10}{'longest':>10}{'together':>10}"
    rows = [
        f"{name:<14}{stage.count:>10}{number(stage.median_s):>11}{number(stage.p90_s):>10}{number(stage.max_s):>10}"
        f"{number(stage.total_s):>10}"
        for name, stage in report.stages.items()
    ]
    return [head, *rows, ""]


def robot_lines(report: RunReport) -> list[str]:
    """A table of robots; errors are left out where no robot has ground truth."""
    robots, known = report.robot_details, report.has_truth()
    errors = f"{'ATE, m':>10}{'odometry':>10}{'RPE, m':>10}{'odometry':>10}" if known else ""
    return [
        f"{'robot':<14}{'keyframes':>10}{errors}  map frame",
        *(
            f"{robot.robot:<14}{robot.keyframes:>10}{errors_of(robot) if known else ''}  {robot.map_frame or '–'}"
            for robot in robots
        ),
        "",
    ]


def errors_of(robot: RobotReport) -> str:
    """The cells of one robot's errors, each beside that of its odometry."""
    corrected, odometry = robot.corrected, robot.odometry
    cells = (corrected.ate_m, odometry.ate_m, corrected.rpe_translation_m, odometry.rpe_translation_m)
    return "".join(f"{number(cell):>10}" for cell in cells)
