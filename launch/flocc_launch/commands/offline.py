"""Commands that need no swarm: optimise, and the campaign of simulate."""

import sys
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from flocc_launch.commands.common import EXIT_MISSED, Json, Speech, facts
from flocc_protocol.errors import FloccError

PROCESSES = 2
WARNINGS_SAID = 10

E = TypeVar("E", bound=Enum)


def add_offline(app: typer.Typer) -> None:
    """Register the commands."""
    app.command(short_help="Optimise the pose graph of a file.")(optimise)


def optimise(
    file: Annotated[Path, typer.Argument(help="A .g2o file, a folder of one per robot, or a .jrl file.")],
    out: Annotated[Path, typer.Option(help="Folder for result.json and trajectories.")],
    formulation: Annotated[str | None, typer.Option(help="base, independent, smoothed or shared scales.")] = None,
    solver: Annotated[str | None, typer.Option(help="lm, gnc-tls, gnc-gm, huber or cauchy.")] = None,
    scale_initial: Annotated[str | None, typer.Option(help="Start of scales: raw, odometry or ground-truth.")] = None,
    consistency: Annotated[
        bool, typer.Option("--pairwise-consistency", help="Filter closures by pairwise consistency first.")
    ] = False,
    unit_scale: Annotated[bool, typer.Option("--unit-scale", help="Free the scale of inter-robot closures.")] = False,
    drop_outliers: Annotated[
        bool, typer.Option("--drop-labelled-outliers", help="Leave out what the file labels as wrong.")
    ] = False,
    from_file: Annotated[
        bool, typer.Option("--from-file-initialisation", help="Start from the file's own initialisation.")
    ] = False,
    noise: Annotated[
        str | None, typer.Option(help="gaussian (the file's information matrices) or isotropic (SE-Sync's objective).")
    ] = None,
    seed: Annotated[int, typer.Option(help="Recorded; nothing in the back end is drawn by chance.")] = 0,
    json_out: Json = False,
) -> None:
    """Optimise the pose graph of a file, with any formulation and solver."""
    from flocc_agent.config import Formulation, ScaleInitial, Solver
    from flocc_launch.graph_files.optimise import NoiseModel, optimise_file

    result = optimise_file(
        file,
        out,
        formulation=chosen(Formulation, formulation, "--formulation"),
        solver=chosen(Solver, solver, "--solver"),
        scale_initial=chosen(ScaleInitial, scale_initial, "--scale-initial"),
        pairwise_consistency=consistency,
        unit_scale=unit_scale,
        drop_labelled_outliers=drop_outliers,
        from_file_initialisation=from_file,
        noise=chosen(NoiseModel, noise, "--noise") or NoiseModel.GAUSSIAN,
        seed=seed,
    )
    if json_out:
        facts(result)
        return
    for key in ("formulation", "solver", "cost_initial", "cost", "ate_m", "iterations", "solve_s"):
        typer.echo(f"{key.replace('_', ' '):14} {result[key] if result[key] is not None else 'not known'}")
    typer.echo(f"{'components':14} {_count(result['components'])}")
    typer.echo(f"{'rejected':14} {len(result['closures_rejected'])} closures")
    warnings = result["warnings"]
    for warning in warnings[:WARNINGS_SAID]:
        typer.echo(f"warning: {warning}", err=True)
    if len(warnings) > WARNINGS_SAID:
        typer.echo(f"warning: {len(warnings) - WARNINGS_SAID} more in result.json", err=True)
    typer.echo(f"result: {(out / 'result.json').resolve()}")


def run_campaign(seeds: int, first: int, shrink: bool, out: Path, speech: Speech, family: str) -> None:
    """Simulate drawn scenarios under all checkers; leave with exit code 1 when an invariant was violated."""
    from flocc_launch.simulation.campaign import SeedOutcome, campaign, write_campaign
    from flocc_launch.simulation.campaign import shrink as smaller
    from flocc_launch.simulation.coverage import table
    from flocc_launch.simulation.generator import FAMILIES, drawn_scenario

    if family not in FAMILIES:
        raise BadOption(f"--family {family!r} is not one of {', '.join(FAMILIES)}")

    def tell(outcome: SeedOutcome) -> None:
        for violation in outcome.violations:
            speech.tell(f"seed {outcome.seed}: {violation.invariant} at {violation.at_s:.2f} s")

    found = campaign(range(first, first + seeds), PROCESSES, tell, family)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "campaign.json"
    write_campaign(found, path)
    failed = [outcome.seed for outcome in found.outcomes if outcome.violations]
    if speech.as_json:
        typer.echo(path.read_text(encoding="utf-8"))
    else:
        speech.tell(f"messages that arrived, by kind, while something was wrong:\n{table(found.coverage())}")
        typer.echo(f"{seeds} runs, {len(failed)} with violations: {path.resolve()}")
    for seed in failed if shrink else ():
        small = out / f"seed-{seed}.json"
        small.write_text(
            smaller(drawn_scenario(seed, FAMILIES[family])).model_dump_json(indent=1) + "\n", encoding="utf-8"
        )
        speech.tell(f"smaller scenario: {small.resolve()}")
    if failed:
        sys.exit(EXIT_MISSED)


def chosen(choices: type[E], text: str | None, option: str) -> E | None:
    """One of an enumeration's values.

    Raises:
        BadOption: It is none of them.
    """
    if text is None:
        return None
    found = next((choice for choice in choices if choice.value == text), None)
    if found is None:
        raise BadOption(f"{option} {text!r} is not one of {', '.join(choice.value for choice in choices)}")
    return found


class BadOption(FloccError):
    """An option whose value is none of its choices."""


def _count(value: Any) -> Any:
    return len(value) if isinstance(value, list) else value
