"""`flocc experiment`: one command per experiment, whose options are its settings, and `list`.

Commands are made when they are called for, so that `flocc --help` imports no experiment. typer carries its own copy of
click in some versions, so click's types have no name here.
"""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer
from typer.core import TyperGroup

from flocc_launch.commands.common import progress_bar

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from flocc_lab.experiments.experiment import Experiment, Row
    from flocc_lab.experiments.runner import Result

Out = Annotated[Path | None, typer.Option(help="Folder of the experiment; default runs/NAME. It goes on where it was.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of everything drawn.")]
Quick = Annotated[bool, typer.Option("--quick", help="The smallest version: seconds, for tests and a first look.")]
Processes = Annotated[int | None, typer.Option(min=1, help="Processes that measure, at most one per core.")]
Config = Annotated[Path | None, typer.Option("--from", help="Take the settings of an earlier config.json.")]


class ExperimentGroup(TyperGroup):
    """Finds experiments when they are asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of the plain commands and of all experiments."""
        from flocc_lab.experiments.registry import names

        return [*super().list_commands(ctx), *names()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A plain command, or the one of an experiment."""
        from flocc_lab.experiments.registry import find

        return super().get_command(ctx, cmd_name) or command_of(find(cmd_name))


experiment = typer.Typer(
    cls=ExperimentGroup,
    help="The paper's evaluation: tables, figures, findings.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@experiment.command("list")
def list_experiments() -> None:
    """Name all experiments."""
    from flocc_lab.experiments.registry import ALL

    for each in ALL:
        typer.echo(f"{each.name:18} {each.title}")


@experiment.command("steepness", short_help="Write the k that a registration experiment learned.")
def write_learned_steepness(
    run: Annotated[Path, typer.Argument(help="Folder of a finished registration experiment.")],
    config: Annotated[Path, typer.Argument(help="Configuration of an agent, or a scenario (TOML).")],
) -> None:
    """Write the k of Eq. (2) that a registration experiment learned into a configuration file."""
    from flocc_lab.experiments.steepness import learned, write_steepness

    found = learned(run)
    write_steepness(config, found.steepness)
    fit = found.fit
    typer.echo(f"{config}: backend.steepness = {found.steepness:g}, from {fit.pairs} registrations ({fit.right} right)")


def command_of(chosen: "Experiment[Any]") -> Any:
    """The command of an experiment."""

    def run(
        out: Path | None, seed: int, quick: bool, processes: int | None, config: Path | None, **given: str | None
    ) -> None:
        settings = settings_of(chosen, {name: text for name, text in given.items() if text is not None}, quick, config)
        _run(chosen, settings, seed, out or Path("runs") / chosen.name, processes)

    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.command(chosen.name, help=f"{chosen.title[0].upper()}{chosen.title[1:]}.")(_with_options(run, chosen))
    return typer.main.get_command(app)


def settings_of(chosen: "Experiment[Any]", given: dict[str, str], quick: bool, config: Path | None) -> Any:
    """Settings from an earlier configuration, the quick version and options, the latter first.

    Raises:
        ConfigError: An option or the file cannot be used.
    """
    from flocc_agent.config import validated

    fields: dict[str, object] = _settings_in(config, chosen.name) if config else {}
    if quick:
        fields |= chosen.quick
    for name, text in given.items():
        fields[name] = _given(text, chosen.settings.model_fields[name].annotation)
    return validated(chosen.settings, fields, f"experiment {chosen.name}")


def _given(text: str, kind: Any) -> object:
    """An option's value: a list is separated by commas, and a perception stands in a configuration file.

    Raises:
        ConfigError: The file cannot be used.
    """
    from flocc_agent.config import PerceptionConfig, read_toml, validated

    if kind is PerceptionConfig:
        path = Path(text)
        found = read_toml(path).get("perception", {})
        return validated(PerceptionConfig, found if isinstance(found, dict) else {}, str(path), path.resolve().parent)
    return [part for part in text.split(",") if part] if get_origin(kind) is tuple else text


def _settings_in(path: Path, name: str) -> dict[str, object]:
    from flocc_agent.config import ConfigError, read_json

    found = read_json(path)
    settings = found.get("settings")
    if found.get("experiment") != name or not isinstance(settings, dict):
        raise ConfigError(f"{path}: is no configuration of the experiment {name}")
    return settings


def _with_options(run: Callable[..., None], chosen: "Experiment[Any]") -> Callable[..., None]:
    """Give a function the signature from which typer makes options."""
    common = {"out": (Out, None), "seed": (Seed, 1), "quick": (Quick, False), "processes": (Processes, None),
              "config": (Config, None)}  # fmt: skip
    own = {name: (_option(field), None) for name, field in chosen.settings.model_fields.items()}
    parameters = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, (annotation, default) in {**common, **own}.items()
    ]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _option(field: "FieldInfo") -> Any:
    """Text, checked by the settings; lists are separated by commas, a section is read from a file."""
    from pydantic import BaseModel

    kind, default = field.annotation, field.default
    is_list, is_section = get_origin(kind) is tuple, isinstance(default, BaseModel)
    shown = ",".join(map(str, default)) if is_list else "its defaults" if is_section else str(default)
    metavar = "LIST" if is_list else "FILE" if is_section else _kind_name(kind)
    return Annotated[str | None, typer.Option(help=f"{field.description} [{shown or 'none'}]", metavar=metavar)]


def _kind_name(kind: Any) -> str:
    """What an option takes: its choices, or the name of its type."""
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    single = next((inner for inner in get_args(kind) if isinstance(inner, type)), kind)
    return str(single.__name__).upper()


def _run(chosen: "Experiment[Any]", settings: Any, seed: int, out: Path, processes: int | None) -> None:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from flocc_lab.experiments.runner import processes_of, run_experiment

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        progress_bar("preparing", "part") as on_prepare,
        Progress(*columns, TimeRemainingColumn(), transient=True) as bar,
    ):
        task = bar.add_task(chosen.name, total=None)

        def on_row(row: "Row", done: int, cells: int) -> None:
            bar.update(task, completed=done, total=cells)
            if row["error"] is not None:
                bar.console.print(f"{row['cell']}: {row['error']}", markup=False)

        result = run_experiment(chosen, settings, seed, out, processes_of(chosen, processes), on_row, on_prepare)
    _tell(chosen, result)


def _tell(chosen: "Experiment[Any]", result: "Result") -> None:
    """Findings, and where everything lies; exit code 1 where cells failed."""
    for finding in result.summary.findings:
        typer.echo(f"{finding.verdict.value}: {finding.claim} ({finding.source}). {finding.numbers}")
    typer.echo(f"table: {(result.folder / f'{chosen.name}.md').resolve()}")
    typer.echo(f"figure: {(result.folder / f'{chosen.name}.png').resolve()}")
    if result.errors:
        typer.echo(f"{len(result.errors)} of {result.cells} cells failed; the same command tries them again", err=True)
        raise typer.Exit(1)
