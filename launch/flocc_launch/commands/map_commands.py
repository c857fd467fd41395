"""`flocc map`: save, look at, merge, prune and export maps. `add_maps` puts them into the command line."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flocc_launch.commands.common import Json, facts

if TYPE_CHECKING:
    from flocc_agent.runtime.map_folder import MapManifest

maps = typer.Typer(help="Save a map, look at it, merge, prune and export it.", rich_markup_mode=None)

MapArgument = Annotated[Path, typer.Argument(help="Folder of a map.")]
MapOut = Annotated[Path, typer.Option(help="Folder of the map that is written.")]


def add_maps(app: typer.Typer) -> None:
    """Register the commands."""
    app.add_typer(maps, name="map")


@maps.command()
def save(
    out: MapOut,
    run: Annotated[Path | None, typer.Argument(help="Run folder, or the folder of one agent.")] = None,
    name: Annotated[str | None, typer.Option(help="What the map is called; the folder's name otherwise.")] = None,
    frame: Annotated[str | None, typer.Option(help="Of several maps the one of this frame, such as map/r1.")] = None,
    swarm: Annotated[str | None, typer.Option(help="Instead: a running swarm, found by scouting.")] = None,
    config: Annotated[
        Path | None, typer.Option(help="... or reached and seen as this agent's configuration says.")
    ] = None,
) -> None:
    """Save the map of a run, or of a running swarm: its logs, latents and solution, in one step."""
    if (run is None) == (swarm is None and config is None):
        raise typer.BadParameter("give a run folder, or --swarm NAME, or --config of an agent", param_hint="RUN")
    from flocc_launch.maps.map_info import contradicted_lines

    manifest = _saved_swarm(swarm, config, out, name, frame) if run is None else _saved_run(run, out, name, frame)
    for log, reason in manifest.left_out.items():
        typer.echo(f"left out: {log} {reason}")
    keyframes = sum(entry.keyframes for entry in manifest.logs)
    if not manifest.pruned and manifest.latents < keyframes:
        typer.echo(f"without latents: {keyframes - manifest.latents} keyframes, where no robot can be found")
    for named, logs in contradicted_lines(manifest):
        typer.echo(f"{named}: {logs}")
    typer.echo(f"{manifest.frame}: {len(manifest.logs)} logs, {keyframes} keyframes, {manifest.closures} closures")
    typer.echo(f"map: {out.resolve()}")


def _saved_run(run: Path, out: Path, name: str | None, frame: str | None) -> "MapManifest":
    from flocc_launch.maps.map_saving import save_map

    return save_map(run, out, name, frame)


def _saved_swarm(
    swarm: str | None, config: Path | None, out: Path, name: str | None, frame: str | None
) -> "MapManifest":
    from flocc_agent.config import AgentConfig
    from flocc_launch.commands.common import progress_bar
    from flocc_launch.swarm.harvest import HARVESTER, save_swarm

    read = AgentConfig(name=HARVESTER) if config is None else AgentConfig.read(config)
    if swarm is not None:
        read = read.model_copy(update={"swarm": swarm})
    with progress_bar("copying", "latent") as progress:
        return save_swarm(read, out, name, frame, progress, sees_alike=config is not None)


@maps.command()
def info(folder: MapArgument, json_out: Json = False) -> None:
    """Say what a map holds, and check that it is whole."""
    from flocc_agent.runtime.map_folder import MapFolder
    from flocc_launch.maps.map_info import map_lines, positions_sigma_m

    opened = MapFolder.open(folder)
    lines = list(map_lines(opened))
    if json_out:
        facts({**opened.manifest.model_dump(mode="json"), "positions_sigma_m": positions_sigma_m(opened)})
        return
    for name, value in lines:
        typer.echo(f"{name:14} {value}")


@maps.command()
def export(
    folder: MapArgument,
    out: Annotated[Path, typer.Option(help="Folder for trajectories, pose graph and points.")],
    points: Annotated[bool, typer.Option("--points", help="Also what closures triangulate (PLY).")] = False,
    recordings: Annotated[
        list[Path] | None, typer.Option(help="Recordings, or a folder of them: the points' colours.")
    ] = None,
) -> None:
    """Write a map as trajectories (TUM), pose graph (g2o) and camera poses (PLY)."""
    from flocc_agent.runtime.map_folder import MapFolder
    from flocc_launch.commands.common import progress_bar
    from flocc_launch.maps.map_export import export_map, export_points

    opened = MapFolder.open(folder)
    for path in export_map(opened, out):
        typer.echo(path)
    if not points:
        return
    with progress_bar("matching", "closure") as progress:
        cloud = export_points(opened, out, recordings or [], progress)
    if cloud is None:
        typer.echo("no points: the front end that made this map cannot tell what it matched")
    else:
        typer.echo(f"{cloud[0]}: {cloud[1]} points of {cloud[2]} closures")


@maps.command()
def merge(
    first: Annotated[Path, typer.Argument(help="Map whose frame stays.")],
    second: Annotated[Path, typer.Argument(help="The other one.")],
    out: MapOut,
) -> None:
    """Join two maps of teams that never met, by closures found offline."""
    from flocc_launch.commands.common import progress_bar
    from flocc_launch.maps.map_merging import merge_maps

    with progress_bar("registering", "pair") as progress:
        merged = merge_maps(first, second, out, progress)
    typer.echo(f"{merged.closures} closures of {merged.registered} registered pairs; {merged.manifest.frame}")
    typer.echo(f"map: {out.resolve()}")


@maps.command()
def prune(
    folder: MapArgument,
    out: MapOut,
    place_m: Annotated[float, typer.Option(min=0.0, help="A kept keyframe stands for those so near, metres.")] = 2.0,
    place_deg: Annotated[float, typer.Option(min=0.0, max=180.0, help="... that look so far away from it.")] = 30.0,
) -> None:
    """Write a map with the fewest latents that keep its places."""
    from flocc_agent.runtime.map_folder import MapFolder
    from flocc_launch.maps.map_pruning import prune_map

    before = MapFolder.open(folder).manifest
    after = prune_map(folder, out, place_m, place_deg)
    sizes = f"{before.latent_file.bytes / 1e6:.1f} to {after.latent_file.bytes / 1e6:.1f} MB"
    typer.echo(f"{before.latents} to {after.latents} latents, {sizes}")
    typer.echo(f"map: {out.resolve()}")


@maps.command()
def sessions(
    recordings_of: Annotated[
        str, typer.Argument(metavar="DATA", help="Folder of one recording per session, or a scenario.")
    ],
    out: MapOut,
    runs: Annotated[Path, typer.Option(help="Folder for the run and the map of each session.")] = Path("runs/sessions"),
    begin: Annotated[Path | None, typer.Option("--map", help="A map to begin with.")] = None,
    sets: Annotated[list[str] | None, typer.Option("--set", help="Another value for a key.")] = None,
) -> None:
    """Make one map of recordings of different times, one after the other, in the order of their names."""
    from flocc_agent.config import parsed_change
    from flocc_launch.commands.common import progress_bar
    from flocc_launch.scenarios.recordings import recordings
    from flocc_launch.scenarios.shipped import read_scenario
    from flocc_launch.setup.cache import cache_folder
    from flocc_launch.simulation.sessions import Session, map_of_sessions

    def tell(session: Session) -> None:
        closures = session.report.closures.accepted
        typer.echo(f"{session.name}: {session.left_out or f'in {session.report.map_frames[0]}, {closures} closures'}")

    changes = dict(parsed_change(text) for text in sets or ())
    scenario = read_scenario(recordings_of, changes, None, typer.echo)
    with progress_bar("preparing data") as progress:
        paths = recordings(scenario, progress)
    manifest = map_of_sessions(scenario, paths, out, runs, begin, cache_folder() / "perception", tell)
    typer.echo(f"{manifest.frame}: edition {manifest.edition}, {manifest.poses} logs, {manifest.closures} closures")
    typer.echo(f"map: {out.resolve()}")
