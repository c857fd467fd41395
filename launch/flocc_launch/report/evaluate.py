"""`flocc evaluate`: finish a run folder anew and say what came of it."""

from pathlib import Path

from flocc_launch.report.album import Progress
from flocc_launch.report.finish import finish
from flocc_launch.report.paper_figures import write_plots
from flocc_launch.report.shown_pairs import PAIRS_SHOWN
from flocc_launch.report.text import sentences, short_sentences
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.trajectory_errors import EvaluationError, evo_ape, evo_program


def evaluate(
    run: Path,
    with_evo: bool = False,
    as_json: bool = False,
    plot: bool = False,
    pairs_max: int | None = None,
    progress: Progress | None = None,
    quiet: bool = False,
    verbose: bool = False,
) -> str:
    """Write a run folder's trajectories, report.json and report.html again, and put the result into words.

    Args:
        run: Run folder.
        with_evo: Add what evo says of each robot's corrected trajectory.
        as_json: Give the report as JSON instead of sentences.
        plot: Write figures, too.
        pairs_max: Pairs of keyframes that report.html shows as pictures; the usual number where None.
        progress: Called with (done, all) while pictures are looked at.
        quiet: Give the verdict only.
        verbose: Give bytes by kind and times by stage as well.

    Raises:
        RunFolderError: The folder is missing, cut off, or of another version.
        FloccError: evo or matplotlib is asked for and not installed.
    """
    folder = RunFolder.open(run)
    report = finish(folder, PAIRS_SHOWN if pairs_max is None else pairs_max, progress)
    drawn = write_plots(load(folder), run) if plot else []
    if as_json:
        return report.model_dump_json(indent=1)
    lines = short_sentences(report) if quiet else sentences(report, verbose)
    if with_evo:
        program = evo_program()
        lines += [evo_of(run, robot, program) for robot in report.robots]
    lines += [f"figure: {path.resolve()}" for path in drawn]
    return "\n".join([*lines, f"report: {(run / 'report.html').resolve()}"])


def evo_of(run: Path, robot: str, program: str) -> str:
    """What evo says of one robot, or why it says nothing; a robot that it refuses costs itself."""
    truth, estimate = run / "groundtruth" / f"{robot}.tum", run / "trajectories" / f"{robot}.tum"
    if not truth.exists() or not estimate.exists():
        return f"{robot}: evo has nothing to compare ({'no ground truth' if not truth.exists() else 'no correction'})"
    try:
        return f"{robot}: evo_ape\n{evo_ape(truth, estimate, program)}"
    except EvaluationError as error:
        return f"{robot}: {error}"
