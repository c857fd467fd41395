"""Commands on what runs: doctor, status, dashboard, view, chaos. `add_tools` puts them into the command line."""

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flocc_launch.commands.common import Json, facts

if TYPE_CHECKING:
    from flocc_agent.config import TransportConfig
    from flocc_launch.doctor import Finding

EXIT_BLOCKED = 1
WIDTH_PIPE = 140

RunArgument = Annotated[Path | None, typer.Argument(help="Run folder.")]
ConfigOption = Annotated[Path | None, typer.Option(help="An agent's configuration: its swarm and how to reach it.")]
SwarmOption = Annotated[str | None, typer.Option(help="Name of a running swarm, found by scouting.")]

TimeoutOption = Annotated[
    float, typer.Option(min=0.1, help="Seconds for each of two tries to be answered; thrice that to find anybody.")
]


def add_tools(app: typer.Typer) -> None:
    """Register the commands."""
    app.command(short_help="Say why maps have or have not merged; check an installation.")(doctor)
    app.command(short_help="Show all robots of a swarm or of a run in one table.")(status)
    app.command(short_help="Serve one page that shows a run while it goes on.")(dashboard)
    app.command(short_help="Show a run or a running swarm in rerun.")(view)
    app.command(short_help="Write a run as one MCAP file, for Foxglove, rerun and others.")(export)
    app.command(short_help="Cause a fault in a running swarm, or take it back.")(chaos)


def doctor(
    run: RunArgument = None,
    config: ConfigOption = None,
    swarm: SwarmOption = None,
    installation: Annotated[bool, typer.Option("--installation", help="Check this machine for --config.")] = False,
    json_out: Json = False,
    timeout: TimeoutOption = 3.0,
) -> None:
    """Say why maps have or have not merged: of a run folder, of a running swarm, or check this installation."""
    from flocc_agent.config import AgentConfig
    from flocc_launch.dashboard.status_table import status_of_swarm
    from flocc_launch.doctor import diagnose
    from flocc_launch.doctor.installation import check_installation
    from flocc_launch.doctor.live import diagnose_live
    from flocc_launch.runs.run_folder import RunFolder

    if run is not None:
        findings = diagnose(RunFolder.open(run))
    elif installation and config is not None:
        read = AgentConfig.read(config)
        findings = check_installation(read.folder, read.transport, read.perception)
    elif config is not None or swarm is not None:
        findings = diagnose_live(status_of_swarm(*_reach(config, swarm), timeout_s=timeout))
    else:
        findings = check_installation()
    _print_findings(findings, json_out)


def status(
    run: RunArgument = None,
    config: ConfigOption = None,
    swarm: SwarmOption = None,
    json_out: Json = False,
    timeout: TimeoutOption = 3.0,
    watch_s: Annotated[float | None, typer.Option("--watch", min=0.2, help="Ask again after so many seconds.")] = None,
) -> None:
    """Show every robot of a running swarm, or of a run folder, in one table."""
    from rich.console import Console

    from flocc_launch.dashboard.status_table import status_json, status_of_run, status_of_swarm, status_table

    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH_PIPE)
    while True:
        rows = status_of_run(run) if run is not None else status_of_swarm(*_reach(config, swarm), timeout_s=timeout)
        if json_out:
            typer.echo(status_json(rows))
        else:
            console.print(status_table(rows))
        if watch_s is None:
            return
        time.sleep(watch_s)


def dashboard(
    run: Annotated[Path, typer.Argument(help="Run folder, of a run that goes on or is over.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")] = 8642,
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 shows the page to the network.")
    ] = "127.0.0.1",
) -> None:
    """Serve one page that shows a run while it goes on; Ctrl-C ends it."""
    from flocc_launch.dashboard import Dashboard
    from flocc_launch.runs.run_folder import RunFolder

    with Dashboard(RunFolder.open(run), port, host) as page:
        typer.echo(f"dashboard: {page.url}")
        while True:
            time.sleep(3600)


def export(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    mcap: Annotated[Path | None, typer.Option(help="The file; run.mcap in the run folder where not given.")] = None,
) -> None:
    """Write a run as MCAP with Foxglove's schemas, and a layout beside it."""
    from flocc_launch.runs.run_folder import RunFolder
    from flocc_launch.view.mcap_file import MCAP_NAME, write_mcap

    path = write_mcap(RunFolder.open(run), run / MCAP_NAME if mcap is None else mcap)
    typer.echo(f"{path} ({path.stat().st_size / 1e6:.1f} MB), layout {path.with_suffix('.layout.json')}")


def view(
    run: RunArgument = None,
    save: Annotated[Path | None, typer.Option(help="Write an .rrd file instead of opening the viewer.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Show what happens, of a run folder that still grows.")] = False,
    config: ConfigOption = None,
    swarm: SwarmOption = None,
    duration: Annotated[float | None, typer.Option(help="End a live view after this many seconds.")] = None,
) -> None:
    """Show a run or a running swarm in rerun: trajectories, closures, images, links, leaders, residuals over time.

    A running swarm is listened to by a session that only subscribes, until Ctrl-C.
    """
    from flocc_launch.runs.run_folder import RunFolder

    end_s = float("inf") if duration is None else time.monotonic() + duration

    def is_over() -> bool:
        return time.monotonic() >= end_s

    if run is None:
        from flocc_agent.config import BackendConfig
        from flocc_agent.runtime.network_faults import network_faults
        from flocc_agent.runtime.zenoh_observer import Observer
        from flocc_launch.view.live_view import view_swarm

        transport, name = _reach(config, swarm)
        for fault in network_faults(transport, ""):
            typer.echo(f"note: {fault}", err=True)
        shown = view_swarm(Observer(transport, name), save, BackendConfig().steepness, is_over)
    elif live:
        from flocc_launch.view.live_view import view_growing

        shown = view_growing(RunFolder.open(run), save, is_over)
    else:
        from flocc_launch.view.run_view import view as show

        shown = show(RunFolder.open(run), save)
    typer.echo(f"view: {shown}")


def chaos(
    order: Annotated[list[str], typer.Argument(help="Such as: loss 0.3, 'partition r1,r2 | r3', heal, kill r2.")],
    config: ConfigOption = None,
    swarm: SwarmOption = None,
    json_out: Json = False,
) -> None:
    """Cause a fault in a running swarm whose agents allow it (transport.chaos), or take faults back."""
    from flocc_launch.swarm.chaos_orders import disturb, parse_order

    parsed = parse_order(" ".join(order))
    answers = disturb(*_reach(config, swarm), parsed)
    if json_out:
        facts(answers)
        return
    for robot, answer in answers.items():
        typer.echo(f"{robot}: {answer}")


def _reach(config: Path | None, swarm: str | None) -> "tuple[TransportConfig, str]":
    """How to reach a swarm, and its name.

    Raises:
        ConfigError: The configuration cannot be read, or nothing says which swarm.
    """
    from flocc_agent.config import AgentConfig, ConfigError, TransportConfig

    if config is not None:
        read = AgentConfig.read(config)
        return read.transport, swarm or read.swarm
    if swarm is None:
        raise ConfigError("give a run folder, --swarm NAME, or --config of an agent")
    return TransportConfig(), swarm


def _print_findings(findings: "list[Finding]", json_out: bool) -> None:
    """Print findings; leave with 1 where something blocks."""
    from flocc_launch.doctor import Severity, finding_lines

    if json_out:
        fields = [
            {"cause": f.cause, "severity": f.severity.name.lower(), "sentence": f.sentence, "advice": f.advice,
             "robots": list(f.robots)}
            for f in findings
        ]  # fmt: skip
        typer.echo(json.dumps(fields, indent=1))
    else:
        typer.echo("\n".join(finding_lines(findings)) or "nothing to report")
    if any(finding.severity is Severity.BLOCKS for finding in findings):
        sys.exit(EXIT_BLOCKED)
