"""`flocc bench`: benchmarks whose results are ratios measured in one run."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from flocc_launch.commands.offline import chosen

bench = typer.Typer(help="Benchmarks: ratios measured in one run.", rich_markup_mode=None)

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@bench.command()
def solver(
    keyframes: Annotated[int | None, typer.Option(min=100, help="One graph of so many keyframes, by itself.")] = None,
    closures: Annotated[int, typer.Option(min=20, help="Closures of that graph.")] = 1000,
    robots: Annotated[int, typer.Option(min=1, help="Robots of that graph.")] = 1,
    formulation: Annotated[str | None, typer.Option(help="The default is the agent's.")] = None,
    method: Annotated[str | None, typer.Option(help="Solver; the default is the agent's.")] = None,
    json_out: JsonOption = False,
) -> None:
    """The back end against GTSAM's own C++ factors and solvers; or what one graph of a size costs, and ten closures."""
    if keyframes is not None:
        from flocc_agent.config import Formulation, Solver
        from flocc_lab.bench import solver_sizes

        kind = chosen(Formulation, formulation, "--formulation")
        result = solver_sizes.run(robots, keyframes, closures, kind, chosen(Solver, method, "--method"))
        typer.echo(json.dumps(result, indent=1) if json_out else solver_sizes.text(result))
        return
    from flocc_lab.bench.solver_ratios import run

    _print_bench(run(), json_out)


@bench.command()
def registration(json_out: JsonOption = False) -> None:
    """The MASt3R front end against its plain fp32 path."""
    from flocc_lab.bench.registration_ratios import run

    _print_bench(run(), json_out)


@bench.command()
def perception(
    shared: Annotated[Path | None, typer.Argument(help="Folder of the research sets, as ../shared/data.")] = None,
    recordings: Annotated[list[Path] | None, typer.Option(help="Recordings with ground truth.")] = None,
    config: Annotated[Path | None, typer.Option(help="An agent's configuration; its perception is judged.")] = None,
    json_out: JsonOption = False,
) -> None:
    """Precision, recall and pose errors of a perception back-end on recorded images with ground truth."""
    from flocc_agent.config import AgentConfig
    from flocc_lab.bench.perception_quality import run, text

    chosen = None if config is None else AgentConfig.read(config).perception
    report = run(shared, chosen, recordings or ())
    typer.echo(json.dumps(report, indent=1) if json_out else text(report))


@bench.command()
def acceptance(
    shared: Annotated[Path, typer.Argument(help="Folder of the research sets, as ../shared/data.")],
    front_end: Annotated[list[str], typer.Option(help="classical, or a model of the learned one; repeat for more.")],
    recordings: Annotated[list[Path] | None, typer.Option(help="Recordings with ground truth: one more scene.")] = None,
    scene: Annotated[list[str] | None, typer.Option(help="Only these scenes; all without.")] = None,
    pairs: Annotated[int, typer.Option(min=8, help="Pairs of a scene; fewer are some of more.")] = 300,
    out: Annotated[Path, typer.Option(help="Folder that keeps latents and rows; rows there are used again.")] = Path(
        "runs/acceptance"
    ),
    json_out: JsonOption = False,
) -> None:
    """Which pairs each front end accepts, right and wrong, by scene and angle; its rule fitted leave-one-scene-out."""
    from flocc_lab.bench.acceptance_fit import report, rule_in_use, text
    from flocc_lab.bench.acceptance_rows import collected

    for name in front_end:
        rows = collected(name, shared, recordings or (), scene or (), pairs, out)
        found = report(rows, rule_in_use(name))
        typer.echo(json.dumps({name: found}, indent=1) if json_out else text(name, found))


def _print_bench(result: dict[str, Any], json_out: bool) -> None:
    if json_out:
        typer.echo(json.dumps(result, indent=1))
        return
    for name, ratio in result["ratios"].items():
        shown = "n/a" if ratio is None else json.dumps(ratio)
        typer.echo(f"{name:44} {shown}")
