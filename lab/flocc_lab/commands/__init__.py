"""The commands of the lab: `flocc experiment` and `flocc bench`. The command line finds them by name."""

import typer

from flocc_lab.commands.bench import bench
from flocc_lab.commands.experiments import experiment


def add_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.add_typer(bench, name="bench")
    app.add_typer(experiment, name="experiment")
