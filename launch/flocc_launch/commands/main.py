"""The command line. Commands import what they need when they run, so that `--help` stays fast."""

import os
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from flocc_launch.commands.common import (
    EXIT_BAD_INPUT,
    EXIT_READER_LEFT,
    EXIT_TRY_AGAIN,
    Json,
    Quiet,
    Speech,
    Verbose,
    progress_bar,
    say_warnings_once,
    show_report,
)
from flocc_launch.commands.data import add_data
from flocc_launch.commands.lab import add_lab
from flocc_launch.commands.map_commands import add_maps
from flocc_launch.commands.offline import add_offline, run_campaign
from flocc_launch.commands.tools import add_tools
from flocc_launch.setup.world_faults import may_pass, sentence_of, speak_utf8

if TYPE_CHECKING:
    from collections.abc import Iterator

    from flocc_launch.maps.opening import MapUse
    from flocc_launch.scenarios.scenario import Scenario
    from flocc_launch.swarm.launching import OnWatch

app = typer.Typer(
    name="flocc",
    epilog="Start with 'flocc demo', or 'flocc launch FOLDER' with images and a trajectory of your own.",
    context_settings={"max_content_width": 110},
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=True,
)


def _show_version(wanted: bool) -> None:
    """Print the version of the installed distribution, and of the wire."""
    if wanted:
        from flocc_launch.runs.version import flocc_version
        from flocc_protocol.messages import PROTOCOL_VERSION

        typer.echo(f"flocc {flocc_version()} (protocol {PROTOCOL_VERSION})")
        raise typer.Exit


@app.callback()
def options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and leave.")
    ] = False,
) -> None:
    """Decentralized collaborative SLAM: run swarms of agents on one machine, in simulation, or on robots."""


FIXED_WHAT = "--map-fixed says of --map that it does not move; give --map FOLDER"
WHAT_RUNS = "Scenario file (TOML), name of a shipped one, or own data: a data set, a bag, a folder of one per robot."
ROS_ARGS = "All that follows goes to ROS 2: -p KEY:=VALUE, -r FROM:=TO, --params-file FILE."
HOW_MANY = "Number of robots of the world, or into which one data set is cut."
Out = Annotated[Path, typer.Option(help="Run folder; an earlier run of the same scenario in it is replaced.")]
Loss = Annotated[float | None, typer.Option(min=0.0, max=1.0, help="Share of messages lost on every link, 0 to 1.")]
Latency = Annotated[float | None, typer.Option(min=0.0, help="Delay on every link, seconds.")]
Bandwidth = Annotated[float | None, typer.Option(min=0.001, help="Capacity of a link and budget of a robot, kB/s.")]
Range = Annotated[float | None, typer.Option("--range", min=0.0, help="Communication range by true position, metres.")]
Duration = Annotated[float | None, typer.Option(min=0.001, help="End after so many seconds, not when all is settled.")]
Seed = Annotated[int | None, typer.Option(help="Seed of links, boots and worker answers.")]
Map = Annotated[Path | None, typer.Option("--map", help="A saved map in which the robots find themselves.")]
MapFixed = Annotated[bool, typer.Option("--map-fixed", help="The map does not move, whatever is measured in it.")]
Set = Annotated[list[str] | None, typer.Option("--set", help="Another value for a key, such as radio.loss_ratio=0.3.")]


def main() -> None:
    """Entry point: one clear sentence and exit code 2 for bad input, a traceback only for a bug."""
    speak_utf8()
    say_warnings_once()
    try:
        app(with_ros_args(sys.argv[1:]), prog_name="flocc")
    except SystemExit:
        if type(sys.stdout).__name__ == "PacifyFlushWrapper":  # put there where a pipe's reader has left
            sys.exit(EXIT_READER_LEFT)
        raise
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        sentence = sentence_of(error)
        if sentence is None:
            raise
        fail(sentence)


def with_ros_args(words: list[str]) -> list[str]:
    """Words of a command line with each one between `--ros-args` and its end (or `--`) as that option's value."""
    if "--ros-args" not in words:
        return words
    at = words.index("--ros-args")
    given, rest = words[at + 1 :], list[str]()
    if "--" in given:
        given, rest = given[: given.index("--")], given[given.index("--") + 1 :]
    return [*words[:at], *rest, *(f"--ros-args={word}" for word in given)]


def fail(sentence: str, code: int = EXIT_BAD_INPUT) -> NoReturn:
    """Print an error and leave."""
    typer.echo(f"error: {sentence}", err=True)
    sys.exit(code)


@app.command(short_help="Robots in a generated town, real zenoh: one map, one report.")
def demo(
    out: Out = Path("runs/demo"),
    robots: Annotated[int, typer.Option(min=2, max=8, help="Robots in the generated world.")] = 3,
    seed: Annotated[int, typer.Option(help="Another seed is another world.")] = 7,
    small: Annotated[bool, typer.Option("--small", help="Shorter routes, smaller pictures: within a minute.")] = False,
    json_out: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run the main job: robots in a generated world, real images, real zenoh, one report."""
    from flocc_launch.scenarios.shipped import read_shipped
    from flocc_launch.scenarios.small_demo import small_demo

    speech = Speech(json_out, quiet, verbose)
    _check_place(out)
    if not small:
        _launch(read_shipped("demo", {"world.robots": robots, "world.seed": seed}), out, speech)
        return
    with progress_bar("preparing data") as progress:
        scenario = small_demo(robots, seed, progress)
    _launch(scenario, out, speech)


@app.command(short_help="Run a scenario or your own data, a process per robot.")
def launch(
    scenario: Annotated[str, typer.Argument(help=WHAT_RUNS)],
    out: Out = Path("runs/launch"),
    agents: Annotated[int | None, typer.Option(min=1, help=HOW_MANY)] = None,
    loss: Loss = None,
    latency: Latency = None,
    bandwidth: Bandwidth = None,
    range_m: Range = None,
    duration: Duration = None,
    seed: Seed = None,
    sets: Set = None,
    rate: Annotated[float | None, typer.Option(help="Playback speed of recordings.")] = None,
    dashboard: Annotated[str | None, typer.Option(help="Serve a live page at [HOST:]PORT.")] = None,
    metrics: Annotated[str | None, typer.Option(help="Serve metrics at [HOST:]PORT, one port per robot.")] = None,
    secure: Annotated[bool, typer.Option(help="Mutual TLS and signed records, with keys made for this run.")] = False,
    mcap: Annotated[Path | None, typer.Option(help="The run as MCAP; run.mcap in --out where not given.")] = None,
    foxglove: Annotated[str | None, typer.Option(help="Serve the run to Foxglove at [HOST:]PORT.")] = None,
    json_out: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    map_folder: Map = None,
    map_fixed: MapFixed = False,
) -> None:
    """Run a scenario with one process per robot on this machine, over real zenoh."""
    changes = _changes(loss=loss, latency=latency, bandwidth=bandwidth, range_m=range_m, duration=duration, seed=seed)
    changes |= {} if rate is None else {"rate": rate}
    changes |= _parsed(sets)
    if mcap is not None or foxglove is not None:
        from flocc_launch.view.scene_drawing import foxglove_module

        foxglove_module()  # a missing package is said before the run, not after it
    if mcap is not None:
        from flocc_launch.view.mcap_file import check_mcap_target

        check_mcap_target(mcap)
    use = _map_use(map_folder, map_fixed)
    speech = Speech(json_out, quiet, verbose)
    _launch(_read(scenario, changes, agents, speech), out, speech, secure, dashboard, metrics, mcap, foxglove, use)


@app.command(short_help="Run the same on virtual time: one process, repeatable.")
def simulate(
    scenario: Annotated[str | None, typer.Argument(help=WHAT_RUNS)] = None,
    out: Out = Path("runs/simulate"),
    agents: Annotated[int | None, typer.Option(min=1, help=HOW_MANY)] = None,
    seed: Seed = None,
    loss: Loss = None,
    latency: Latency = None,
    bandwidth: Bandwidth = None,
    range_m: Range = None,
    duration: Duration = None,
    sets: Set = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Instead: so many drawn scenarios under checkers.")] = None,
    family: Annotated[
        str, typer.Option(help="Of the drawn ones: small, large (20 robots, ten minutes) or hour (20 robots).")
    ] = "small",
    shrink: Annotated[bool, typer.Option("--shrink", help="Find a smaller scenario for each failing seed.")] = False,
    json_out: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    map_folder: Map = None,
    map_fixed: MapFixed = False,
) -> None:
    """Run a scenario in one process on virtual time; the same seed gives the same run, bit for bit."""
    speech = Speech(json_out, quiet, verbose)
    if seeds is not None and sets:
        fail("a campaign draws its scenarios; --set changes one, without --seeds")
    ignored = {
        "SCENARIO": scenario, "--agents": agents, "--loss": loss, "--latency": latency, "--bandwidth": bandwidth,
        "--range": range_m, "--duration": duration, "--map": map_folder, "--map-fixed": map_fixed or None,
    }  # fmt: skip
    given = [name for name, value in ignored.items() if value is not None]
    if seeds is not None and given:
        fail(f"a campaign draws its scenarios; {given[0]} is for one of your own, without --seeds")
    if seeds is not None:
        run_campaign(seeds, seed or 0, shrink, out, speech, family)
        return
    if scenario is None:
        fail("simulate needs a scenario, or --seeds for a campaign of drawn ones")
    use = _map_use(map_folder, map_fixed)
    from flocc_launch.scenarios.expectations import check_measurable
    from flocc_launch.scenarios.recordings import recordings
    from flocc_launch.setup.cache import cache_folder
    from flocc_launch.simulation.simulate import simulate as run
    from flocc_launch.swarm.fresh_folder import fresh_folder

    changes = _changes(loss=loss, latency=latency, bandwidth=bandwidth, range_m=range_m, duration=duration, seed=seed)
    read = _read(scenario, changes | _parsed(sets), agents, speech)
    with progress_bar("preparing data") as progress:
        paths = recordings(read, progress)
    check_measurable(read, paths)
    if use is not None:
        use.check_fully(read)  # before the earlier run goes
    with fresh_folder(out, read.name, use):
        show_report(run(read, out, recordings=paths, cache=cache_folder() / "perception", use=use), out, speech)


@app.command()
def agent(
    config: Annotated[Path, typer.Option(help="Configuration of the agent (TOML); see docs/configuration.md.")],
    changes: Set = None,
    dashboard: Annotated[str | None, typer.Option(help="Serve this agent's view of the swarm at [HOST:]PORT.")] = None,
    metrics: Annotated[str | None, typer.Option(help="Serve metrics for Prometheus at [HOST:]PORT.")] = None,
    bandwidth: Annotated[
        float | None, typer.Option(min=0.001, help="Budget of this robot, kilobytes per second.")
    ] = None,
    map_folder: Map = None,
    map_fixed: MapFixed = False,
    new_journey: Annotated[
        bool, typer.Option("--new-journey", help="The odometry began anew: another log of the same robot.")
    ] = False,
    verbose: Annotated[bool, typer.Option(help="Log every message.")] = False,
    ros_args: Annotated[list[str] | None, typer.Option("--ros-args", help=ROS_ARGS)] = None,
) -> None:
    """Run one robot's agent until it is stopped."""
    import asyncio
    import logging
    import time

    from flocc_agent.config import AgentConfig, MetricsConfig
    from flocc_agent.runtime.freed_memory import have_one_heap
    from flocc_launch.swarm.agent_process import Beginning, ToldOfMap, run_agent

    have_one_heap()
    level = logging.DEBUG if verbose else logging.INFO
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)-7s %(message)s")
    given: dict[str, Any] = {} if metrics is None else {"metrics": MetricsConfig.at(metrics)[0]}
    if bandwidth is not None:
        given["bandwidth_bytes_s"] = 1000.0 * bandwidth
    read = AgentConfig.read(config, changes or ()).model_copy(update=given)
    read = read.with_map(map_folder)
    if map_fixed and read.map is None:
        fail(FIXED_WHAT)
    _check_owner(read.folder)
    beginning = Beginning(map_fixed, new_journey)
    try:
        asyncio.run(
            run_agent(
                read,
                time.monotonic(),
                ToldOfMap(read.name).tell,
                dashboard=dashboard,
                beginning=beginning,
                ros_args=ros_args or (),
            )
        )
    except Exception as error:
        if not may_pass(error):
            raise
        fail(str(sentence_of(error)), EXIT_TRY_AGAIN)


@app.command(short_help="Compute a run's report anew: errors, closures, bytes, leaders.")
def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    evo: Annotated[bool, typer.Option("--evo", help="Compute the errors with evo (GPL-3) beside ours.")] = False,
    json_out: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    plot: Annotated[bool, typer.Option("--plot", help="Write trajectories and errors as PNG and SVG.")] = False,
    pictures: Annotated[
        int | None, typer.Option(min=0, max=200, help="Pairs of keyframes that the report shows as pictures; else 24.")
    ] = None,
) -> None:
    """Evaluate a run folder anew: ATE and RPE against ground truth, closures, bytes, leaders."""
    from flocc_launch.report.evaluate import evaluate as run_evaluation

    speech = Speech(json_out, quiet, verbose)
    with progress_bar("matching pictures") as progress:
        said = run_evaluation(run, evo, json_out, plot, pictures, progress, quiet=speech.quiet, verbose=speech.verbose)
    typer.echo(said)


def _read(scenario: str, changes: dict[str, Any], agents: int | None, speech: Speech) -> "Scenario":
    from flocc_launch.scenarios.shipped import read_scenario

    return read_scenario(scenario, changes, agents, speech.tell)


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
        "bandwidth_bytes_s": None if bandwidth is None else 1000.0 * bandwidth,
        "radio.range_m": range_m,
        "duration_s": duration,
        "seed": seed,
    }
    return {key: value for key, value in given.items() if value is not None}


def _parsed(sets: list[str] | None) -> dict[str, Any]:
    """Keys and values of `--set`."""
    from flocc_agent.config import parsed_change

    return dict(parsed_change(text) for text in sets or ())


def _map_use(folder: Path | None, fixed: bool) -> "MapUse | None":
    """The map in which a team is to work."""
    from flocc_launch.maps.opening import MapUse

    if folder is None and fixed:
        fail(FIXED_WHAT)
    return None if folder is None else MapUse(folder, fixed)


def _check_place(out: Path) -> None:
    """See, before anything is prepared for minutes, that a run's folder can be made.

    Raises:
        RunFolderError: It cannot.
    """
    from flocc_launch.runs.run_folder import RunFolderError

    there = _place_of(out)
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise RunFolderError(f"{out}: cannot be made: {there} cannot be written")


def _place_of(folder: Path) -> Path:
    """The folder, or what is there of the way to it."""
    whole = folder.absolute()
    return next(place for place in (whole, *whole.parents) if place.exists())


def _check_owner(folder: Path | None) -> None:
    """See that an agent's folder is not somebody else's; a disk that is read-only or full costs it its memory alone."""
    if folder is None:
        return
    there = _place_of(folder)
    if not os.access(there, os.W_OK) and not os.statvfs(there).f_flag & os.ST_RDONLY:
        fail(
            f"{folder}: permission denied: {there} cannot be written by this user; choose another folder (folder = ...)"
        )


def _launch(
    scenario: "Scenario",
    out: Path,
    speech: Speech,
    secure: bool = False,
    dashboard: str | None = None,
    metrics: str | None = None,
    mcap: Path | None = None,
    foxglove: str | None = None,
    use: "MapUse | None" = None,
) -> None:
    from rich.console import Console

    from flocc_launch.commands.live_table import LiveTable
    from flocc_launch.scenarios.recordings import recordings
    from flocc_launch.swarm.launching import check_network
    from flocc_launch.swarm.launching import launch as run

    _check_place(out)
    check_network()
    with progress_bar("preparing data") as progress:
        paths = recordings(scenario, progress)
    console = Console(stderr=speech.as_json, quiet=speech.quiet)
    with (
        LiveTable(console) as table,
        _dashboard(out, dashboard, table.show, speech) as show,
        _foxglove(out, foxglove, speech),
    ):
        report = run(scenario, out, show, secure=secure, metrics=metrics, paths=paths, use=use)
    failed = _record(out, mcap)
    show_report(report, out, speech)
    if failed and mcap is not None:
        sys.exit(EXIT_BAD_INPUT)


def _record(out: Path, mcap: Path | None) -> bool:
    """Write the run as MCAP, without the package only where somebody asked for it; True where it failed.

    The run is over by then: what came of it is said all the same.
    """
    from flocc_launch.runs.run_folder import RunFolder
    from flocc_launch.view.mcap_file import MCAP_NAME, McapError, write_mcap
    from flocc_launch.view.scene_drawing import FoxgloveMissing

    try:
        write_mcap(RunFolder.open(out), mcap or out / MCAP_NAME)
    except FoxgloveMissing:
        if mcap is not None:
            raise
    except McapError as error:
        typer.echo(f"error: {error}", err=True)
        return True
    return False


@contextmanager
def _foxglove(out: Path, where: str | None, speech: Speech) -> "Iterator[None]":
    """Serve the run to Foxglove, where somebody wants it."""
    if where is None:
        yield
        return
    from flocc_launch.dashboard import address
    from flocc_launch.runs.run_folder import RunFolder
    from flocc_launch.view.mcap_file import foxglove_server

    with foxglove_server(RunFolder(out), *address(where, "foxglove")) as url:
        speech.tell(f"foxglove: {url}")
        yield


@contextmanager
def _dashboard(out: Path, where: str | None, show: "OnWatch", speech: Speech) -> "Iterator[OnWatch]":
    """Serve the dashboard beside the table, where somebody wants one."""
    if where is None:
        yield show
        return
    from flocc_launch.dashboard import address, live_dashboard
    from flocc_launch.runs.run_folder import RunFolder

    host, port = address(where)
    with live_dashboard(RunFolder(out), port, show, host) as both:
        speech.tell(f"dashboard: http://{host}:{port}/")
        yield both


add_tools(app)
add_data(app)
add_maps(app)
add_offline(app)
add_lab(app)

if __name__ == "__main__":
    main()
