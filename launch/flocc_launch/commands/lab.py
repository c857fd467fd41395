"""`flocc experiment` and `flocc bench`: in a clone, not in the wheel. The lab is found by name."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec

import typer

from flocc_protocol.errors import FloccError

LAB = "flocc_lab"
ABSENT = {"experiment": "The paper's evaluation (in a clone).", "bench": "Benchmarks (in a clone)."}
ANYTHING = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


class LabAbsent(FloccError):
    """A command of the lab was asked of a flocc without it."""


def add_lab(app: typer.Typer) -> None:
    """Register the lab's commands, or in their place a sentence that says where they are."""
    if find_spec(LAB) is not None:
        import_module(f"{LAB}.commands").add_commands(app)
        return
    for name, text in ABSENT.items():
        app.command(name, help=text, context_settings=ANYTHING)(_say_absent(name))


def _say_absent(name: str) -> Callable[[typer.Context], None]:
    def run(_: typer.Context) -> None:
        raise LabAbsent(f"flocc {name} is part of the lab, which is not installed: clone flocc, then pip install -e .")

    return run
