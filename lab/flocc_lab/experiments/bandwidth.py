"""`flocc experiment bandwidth`: bytes per closure, and what smaller descriptors and latents cost in accuracy.

Four parts. bytes: a simulated swarm whose latents have the size of each method's. descriptors: recall@1 on recorded or
generated images. keypoints: the classical latent, by how many registrations come out right; only the match's latent is
reduced, because only that one travels. latents: MASt3R's, by what its decoder makes of them with keyed weights.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from flocc_agent.config import PerceptionConfig
from flocc_lab.experiments.bandwidth_parts import (
    KINDS,
    bytes_by_kind,
    descriptor_forms,
    keypoint_accuracy,
    latent_accuracy,
    usable,
)
from flocc_lab.experiments.experiment import Cell, Experiment, ExperimentError, Progress, Row, Settings, Summary
from flocc_lab.experiments.plots import COLOURS, MARKERS
from flocc_lab.experiments.registration_data import RegistrationSettings, data_of, prepare_data
from flocc_lab.experiments.statistics import grouped, middle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Part = Literal["bytes", "descriptors", "keypoints", "latents"]

LATENT_SIZES = {"classical": 136_000, "mast3r int8": 790_000, "mast3r fp16": 1_570_000}


class BandwidthSettings(Settings):
    """Which parts, and on which images."""

    parts: tuple[Part, ...] = ("bytes", "descriptors", "keypoints", "latents")
    """Which of the four parts."""
    latents: tuple[str, ...] = tuple(LATENT_SIZES)
    """Methods of which the simulated swarms' latents have the size."""
    length_m: float = Field(24.0, gt=0)
    """Length of the walks of the simulated swarms."""
    data: Path | None = None
    """Folder of the research sets, as ../shared/data; sevenscenes is used where it is there."""
    worlds: tuple[int, ...] = (7,)
    """Seeds of generated towns."""
    walks: tuple[int, ...] = ()
    """Seeds of walks without images, for synthetic descriptors."""
    perception: PerceptionConfig = PerceptionConfig()
    """Whose descriptors: the [perception] of a configuration file. Keypoints are the classical back-end's."""
    pairs: int = Field(100, ge=2)
    """Pairs of every two robots that are registered with every form of keypoints."""
    network: Literal["tiny", "small", "full"] = "small"
    """MASt3R of keyed weights whose latents are reduced."""
    pictures: int = Field(3, ge=2, le=32)
    """Pictures whose neighbours are decoded with each other."""
    runs: int = Field(3, ge=1, le=100)
    """Repetitions of the simulated swarms."""


def images(settings: BandwidthSettings) -> RegistrationSettings:
    """The images, as the registration experiment names them."""
    return RegistrationSettings(
        data=settings.data, worlds=settings.worlds, walks=settings.walks, perception=settings.perception
    )


def prepare(settings: BandwidthSettings, progress: Progress) -> None:
    """Make the scenes and load the back-end, so that bad data and checkpoints are told at once.

    Raises:
        FloccError: The data cannot be used, or the size of a method's latents is not known.
    """
    unknown = sorted(set(settings.latents) - set(LATENT_SIZES))
    if unknown:
        raise ExperimentError(f"the size of {unknown[0]!r} latents is not known; there are {', '.join(LATENT_SIZES)}")
    if {"descriptors", "keypoints"} & set(settings.parts):
        prepare_data(images(settings), progress)


def cells(settings: BandwidthSettings) -> list[Cell]:
    """All parts."""
    needs_scenes = {"descriptors", "keypoints"} & set(settings.parts)
    names = [name for name, scene in data_of(images(settings)).scenes.items() if usable(scene)] if needs_scenes else []
    by_part = {
        "bytes": [
            Cell({"part": "bytes", "on": name}, run) for name in settings.latents for run in range(settings.runs)
        ],
        "descriptors": [Cell({"part": "descriptors", "on": name}) for name in names],
        "keypoints": [Cell({"part": "keypoints", "on": name}) for name in names],
        "latents": [Cell({"part": "latents", "on": f"keyed {settings.network} network"})],
    }
    return [cell for part in settings.parts for cell in by_part[part]]


def measure(settings: BandwidthSettings, cell: Cell, seed: int) -> Row:
    """One part on one scene: its forms, each with bytes and measures."""
    name = cell.parameters["on"]
    match cell.parameters["part"]:
        case "bytes":
            return {"forms": bytes_by_kind(LATENT_SIZES[name], settings.length_m, seed)}
        case "descriptors":
            return {"forms": descriptor_forms(data_of(images(settings)), name)}
        case "keypoints":
            return {"forms": keypoint_accuracy(data_of(images(settings)), name, settings.pairs, seed)}
        case _:
            return {"forms": latent_accuracy(settings.network, settings.pictures)}


def forms_of(rows: Sequence[Row], part: str) -> list[Row]:
    """All forms of a part, with the scene that they are of."""
    return [{"on": row["on"], **each} for row in rows if row["part"] == part for each in row["forms"]]


def summarise(_settings: BandwidthSettings, rows: Sequence[Row]) -> Summary:
    """A row per form and measure, with what it is of the unreduced one."""
    measures = {
        "bytes": ("bytes_per_closure",),
        "descriptors": ("recall_at_1",),
        "keypoints": ("right", "precision", "direction_error_deg"),
        "latents": ("pointmap_error", "same_matches"),
    }
    table: list[Row] = []
    for part, names in measures.items():
        for on, of_scene in grouped(forms_of(rows, part), "on").items():
            whole = of_scene[0]["form"]
            for (form_name,), group in grouped(of_scene, "form").items():
                unreduced = [each for each in of_scene if each["form"] == whole]
                table += [_line(part, on[0], form_name, name, group, unreduced) for name in names]
    return Summary(table, (), notes(rows))


def _line(part: str, on: str, name: str, measure_name: str, group: Sequence[Row], unreduced: Sequence[Row]) -> Row:
    size, whole_size = middle(group, "bytes"), middle(unreduced, "bytes")
    return {
        "part": part,
        "on": on,
        "form": name,
        "bytes": size,
        "bytes_ratio": size / whole_size if size is not None and whole_size else None,
        "samples": next((n for name in ("pairs", "views", "closures") if (n := middle(group, name)) is not None), None),
        "measure": measure_name,
        "value": middle(group, measure_name),
        "unreduced": middle(unreduced, measure_name),
    }


def notes(rows: Sequence[Row]) -> list[str]:
    """What each part means, and what it cannot show."""
    parts = {row["part"] for row in rows}
    said = {
        "bytes": "bytes: synthetic perception on walks of three robots, latents padded to each method's size; bytes "
        "that all robots sent, per accepted closure between robots.",
        "descriptors": "descriptors: int8 is what travels. The basis of the PCA between two robots is learned on the "
        "views of a third one.",
        "keypoints": "keypoints: registrations of pairs at one place, right within 10 degrees and the scene's limit; "
        "only the match's latent is reduced. 'half' and 'quarter' keep the strongest features.",
        "latents": "latents: keyed random weights. They show what reductions do to this decoder's numbers; they cannot "
        "show what they do to the poses of trained weights, whose latents have another spectrum (rank-K may do far "
        "better there, int8 worse where single channels dwarf others).",
    }
    return [text for part, text in said.items() if part in parts]


def draw(figure: "Figure", _settings: BandwidthSettings, rows: Sequence[Row]) -> None:
    """A panel per part."""
    present = [part for part in ("bytes", "descriptors", "keypoints", "latents") if forms_of(rows, part)]
    columns = min(len(present), 2)
    figure.set_size_inches(5.5 * columns, 4.2 * -(-len(present) // columns))
    panels = figure.subplots(-(-len(present) // columns), columns, squeeze=False).flat
    for part, panel in zip(present, panels, strict=False):
        if part == "bytes":
            _draw_bytes(panel, forms_of(rows, part))
        elif part == "descriptors":
            _draw_tradeoff(panel, forms_of(rows, part), "recall_at_1", "bytes of a descriptor", "recall@1")
        elif part == "keypoints":
            _draw_tradeoff(panel, forms_of(rows, part), "right", "bytes of a keypoint latent", "right registrations")
        else:
            _draw_tradeoff(panel, forms_of(rows, part), "pointmap_error", "bytes of a latent", "error of the pointmaps")
            panel.set_yscale("symlog", linthresh=1e-4)
            panel.set_ylim(top=1.0)
    for panel in list(panels):
        panel.set_visible(False)


def _draw_bytes(panel: "Axes", forms: Sequence[Row]) -> None:
    """Bytes per closure by kind on a logarithmic scale; all kinds but the latents are the same for every method."""
    from matplotlib.ticker import EngFormatter

    names = [name for (name,) in grouped(forms, "on")]
    bars = [(f"latent\n{name}", _per_closure(forms, name, "latent")) for name in names]
    bars += [(kind, _per_closure(forms, names[0], kind)) for kind in (*KINDS[1:], "others")]
    labels, sizes = zip(*sorted(bars, key=lambda bar: bar[1]), strict=True)
    drawn = panel.barh(labels, sizes, color=[COLOURS[label.startswith("latent")] for label in labels])
    panel.bar_label(drawn, fmt=EngFormatter("B", places=1), fontsize=7, padding=2)
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter(EngFormatter("B"))
    panel.set_xlim(1.0, 15.0 * max(sizes))
    panel.tick_params(axis="y", labelsize=7)
    panel.set_xlabel("bytes sent per closure gained")
    panel.grid(visible=False, axis="y")


def _per_closure(forms: Sequence[Row], on: str, kind: str) -> float:
    return middle([row for row in forms if row["on"] == on and row["form"] == kind], "bytes_per_closure") or 0.0


def _draw_tradeoff(panel: "Axes", forms: Sequence[Row], column: str, across: str, up: str) -> None:
    """A measure over bytes, each form named."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for k, ((on,), of_scene) in enumerate(grouped(forms, "on").items()):
        known = [row for row in of_scene if row[column] is not None]
        at = [row["bytes"] for row in known], [row[column] for row in known]
        panel.plot(*at, linestyle="", color=COLOURS[k], marker=MARKERS[k], label=on)
        for row in known:
            beside = (0, 5 if k % 2 == 0 else -10)
            place = row["bytes"], row[column]
            panel.annotate(row["form"], place, beside, textcoords="offset points", fontsize=6, ha="center")
    panel.set_xscale("log")
    panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.margins(x=0.12)
    panel.set_xlabel(across)
    panel.set_ylabel(up)
    panel.set_ylim(0.0, 1.15 * max(row[column] for row in forms if row[column] is not None))
    panel.legend(fontsize=8)


BANDWIDTH = Experiment(
    name="bandwidth",
    title="bytes per closure gained, and what smaller descriptors and latents cost in accuracy",
    settings=BandwidthSettings,
    quick={
        "parts": ("bytes", "descriptors", "latents"),
        "worlds": (),
        "walks": (3,),
        "perception": {"method": "synthetic"},
        "latents": ("classical",),
        "length_m": 8.0,
        "network": "tiny",
        "pictures": 2,
        "runs": 1,
    },
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
)
