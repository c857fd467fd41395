"""The command line. Commands import what they need when they run, so that `--help` stays fast."""

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from flocc_launch.cli_tools import add_tools
from flocc_protocol.errors import FloccError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from flocc_launch.report.model import Report
    from flocc_launch.scenario import Scenario

EXIT_MISSED = 1
EXIT_BAD_INPUT = 2

app = typer.Typer(
    name="flocc",
    help="Decentralized collaborative SLAM: run swarms of agents on one machine, in simulation, or on robots.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)
add_tools(app)

Out = Annotated[Path, typer.Option(help="Run folder; an earlier run in it is replaced.")]
Loss = Annotated[float | None, typer.Option(help="Share of messages lost on every link, 0 to 1.")]
Latency = Annotated[float | None, typer.Option(help="Delay on every link, seconds.")]
Bandwidth = Annotated[float | None, typer.Option(help="Capacity of every link, kilobytes per second.")]
Range = Annotated[float | None, typer.Option("--range", help="Communication range by true position, metres.")]
Duration = Annotated[float | None, typer.Option(help="End after this many seconds instead of when all is settled.")]
Seed = Annotated[int | None, typer.Option(help="Seed of links, boots and worker answers.")]


def main() -> None:
    """Entry point: one clear sentence and exit code 2 for bad input, a traceback only for a bug."""
    try:
        app()
    except FloccError as error:
        fail(str(error))
    except KeyboardInterrupt:
        sys.exit(130)


def fail(sentence: str) -> NoReturn:
    """Print an error and leave."""
    typer.echo(f"error: {sentence}", err=True)
    sys.exit(EXIT_BAD_INPUT)


@app.command()
def demo(
    out: Out = Path("runs/demo"),
    robots: Annotated[int, typer.Option(min=2, max=8, help="Robots in the generated world.")] = 3,
    seed: Annotated[int, typer.Option(help="Another seed is another world.")] = 7,
) -> None:
    """Run the main job: robots in a generated world, real images, real zenoh, one report."""
    from flocc_launch.scenario import Scenario
    from flocc_launch.shipped import read_shipped

    scenario = read_shipped("demo", {"world.robots": robots, "world.seed": seed})
    assert isinstance(scenario, Scenario)
    _launch(scenario, out)


@app.command()
def launch(
    scenario: Annotated[str, typer.Argument(help="Scenario file (TOML), or the name of a shipped one.")],
    out: Out = Path("runs/launch"),
    agents: Annotated[int | None, typer.Option(min=1, help="Number of robots of the world or data set.")] = None,
    loss: Loss = None,
    latency: Latency = None,
    bandwidth: Bandwidth = None,
    range_m: Range = None,
    duration: Duration = None,
    seed: Seed = None,
    rate: Annotated[float | None, typer.Option(help="Playback speed of recordings.")] = None,
    secure: Annotated[bool, typer.Option(help="Mutual TLS and signed records, with keys made for this run.")] = False,
) -> None:
    """Run a scenario with one process per robot on this machine, over real zenoh."""
    changes = _changes(loss=loss, latency=latency, bandwidth=bandwidth, range_m=range_m, duration=duration, seed=seed)
    if rate is not None:
        changes["rate"] = rate
    _launch(_read(scenario, changes, agents), out, secure)


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help="Scenario file (TOML), or the name of a shipped one.")],
    out: Out = Path("runs/simulate"),
    agents: Annotated[int | None, typer.Option(min=1, help="Number of robots.")] = None,
    seed: Seed = None,
    loss: Loss = None,
    latency: Latency = None,
    bandwidth: Bandwidth = None,
    range_m: Range = None,
    duration: Duration = None,
) -> None:
    """Run a scenario in one process on virtual time; the same seed gives the same run, bit for bit."""
    from flocc_launch.data import cache_folder, recordings
    from flocc_launch.launching import fresh_folder
    from flocc_launch.simulation.simulate import simulate as run

    changes = _changes(loss=loss, latency=latency, bandwidth=bandwidth, range_m=range_m, duration=duration, seed=seed)
    read = _read(scenario, changes, agents)
    with _progress("preparing data") as progress:
        paths = recordings(read, progress)
    fresh_folder(out)
    _show(run(read, out, recordings=paths, cache=cache_folder() / "perception"), out)


@app.command()
def agent(
    config: Annotated[Path, typer.Option(help="Configuration of the agent (TOML); see docs/configuration.md.")],
    verbose: Annotated[bool, typer.Option(help="Log every message.")] = False,
) -> None:
    """Run one robot's agent until it is stopped."""
    import asyncio
    import logging
    import time

    from flocc_agent.config import AgentConfig
    from flocc_launch.agent_process import run_agent

    level = logging.DEBUG if verbose else logging.INFO
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)-7s %(message)s")
    asyncio.run(run_agent(AgentConfig.read(config), time.monotonic(), lambda _: None))


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    evo: Annotated[bool, typer.Option("--evo", help="Compute the errors with evo (GPL-3) beside ours.")] = False,
    json_out: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Evaluate a run folder anew: ATE and RPE against ground truth, closures, bytes, leaders."""
    from flocc_launch.report.evaluate import evaluate as run_evaluation

    typer.echo(run_evaluation(run, with_evo=evo, as_json=json_out))


@app.command()
def keys(
    folder: Annotated[Path, typer.Argument(help="Where the authority and a folder per robot stand or will stand.")],
    robots: Annotated[list[str], typer.Argument(help="Names of the robots to admit.")],
    swarm: Annotated[str, typer.Option(help="Name of the swarm; one authority certifies one swarm.")] = "swarm",
) -> None:
    """Make a swarm's certificate authority, and a certificate and a signing key per robot."""
    from flocc_launch.keys import make_keys

    for name, path in make_keys(folder, swarm, robots).items():
        typer.echo(f"{name}: {path}")


dataset = typer.Typer(help="Look at data sets, turn them into recordings, cut them into robots.", rich_markup_mode=None)
app.add_typer(dataset, name="dataset")

Source = Annotated[Path, typer.Argument(help="Folder or bag.")]
Format = Annotated[str | None, typer.Option("--format", help="Name of the format where it is not recognised.")]
CameraFile = Annotated[Path | None, typer.Option(help="Intrinsics (TOML) for a data set that has none.")]


@dataset.command()
def info(source: Source, format_name: Format = None) -> None:
    """Say what a data set holds, without writing anything."""
    from dataclasses import fields

    from flocc_launch.datasets.commands import info as look

    found = look(source, format_name)
    for field in fields(found):
        value = getattr(found, field.name)
        typer.echo(f"{field.name:14} {value if value is not None else 'not known'}")


@dataset.command()
def convert(
    source: Source,
    out: Annotated[Path, typer.Option(help="Folder of the recording.")],
    format_name: Format = None,
    camera: CameraFile = None,
    odometry: Annotated[Path | None, typer.Option(help="TUM file with the robot's odometry.")] = None,
) -> None:
    """Write a data set as one recording; a conversion that was cut short goes on where it ended."""
    from flocc_launch.datasets.commands import convert as run

    with _progress("converting") as progress:
        path = run(source, out, format_name=format_name, camera=camera, odometry=odometry, progress=progress)
    typer.echo(f"recording: {path}")


@dataset.command()
def split(
    source: Source,
    out: Annotated[Path, typer.Option(help="Folder of the recordings.")],
    robots: Annotated[int, typer.Option(min=1, help="Pieces, one per robot.")] = 3,
    seed: Annotated[int, typer.Option(help="Seed of the odometry drift.")] = 0,
    format_name: Format = None,
    camera: CameraFile = None,
) -> None:
    """Cut a data set by time into recordings of several robots, with seeded odometry drift."""
    from flocc_launch.datasets.commands import split as run

    with _progress("cutting") as progress:
        paths = run(source, out, robots, seed=seed, format_name=format_name, camera=camera, progress=progress)
    for path in paths:
        typer.echo(f"recording: {path}")


def _read(scenario: str, changes: dict[str, Any], agents: int | None) -> "Scenario":
    from flocc_launch.shipped import read_scenario

    return read_scenario(scenario, changes, agents)


def _changes(
    loss: float | None,
    latency: float | None,
    bandwidth: float | None,
    range_m: float | None,
    duration: float | None,
    seed: int | None,
) -> dict[str, Any]:
    """What the command line changes in a scenario."""
    given = {
        "radio.loss_ratio": loss,
        "radio.latency_s": latency,
        "radio.bandwidth_bytes_s": None if bandwidth is None else 1000.0 * bandwidth,
        "radio.range_m": range_m,
        "duration_s": duration,
        "seed": seed,
    }
    return {key: value for key, value in given.items() if value is not None}


def _launch(scenario: "Scenario", out: Path, secure: bool = False) -> None:
    from rich.console import Console

    from flocc_launch.data import recordings
    from flocc_launch.launching import launch as run
    from flocc_launch.live_table import LiveTable

    with _progress("preparing data") as progress:
        recordings(scenario, progress)
    with LiveTable(Console()) as table:
        report = run(scenario, out, table.show, secure=secure)
    _show(report, out)


@contextmanager
def _progress(what: str) -> "Iterator[Callable[[int, int], None]]":
    """A progress bar that takes (done, all)."""
    from rich.progress import Progress

    with Progress(transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _show(report: "Report", out: Path) -> None:
    from flocc_launch.report.text import sentences

    for sentence in sentences(report):
        typer.echo(sentence)
    typer.echo(f"report: {(out / 'report.html').resolve()}")
    if any(expectation.met is False for expectation in report.expectations):
        sys.exit(EXIT_MISSED)


if __name__ == "__main__":
    main()
