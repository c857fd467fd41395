"""`flocc experiment split-compute`: encode once per keyframe against encode both images of every candidate (Sec. IV-D).

Counts come from a run; the time per encoding and decoding from keyed weights on this machine, which compute as fast as
real ones, and from the user's own measurements on another device, such as a Jetson.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Literal, Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.core.reports import ClosureAccepted, ClosureRejected, Fact, KeyframeTaken
from flocc_agent.perception.backends import build_perception
from flocc_agent.runtime.event_lines import Reported, of_kind
from flocc_lab.bench.acceptance_rows import perception_of
from flocc_lab.codebook.procedural import random_scene, random_view
from flocc_lab.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    ExperimentFinding,
    Progress,
    Row,
    Settings,
    Summary,
    grid,
    judged,
)
from flocc_lab.experiments.keyed_engine import SIZES_PX, keyed_engine, keyed_pictures
from flocc_lab.experiments.plots import COLOURS
from flocc_lab.experiments.simulated import simulated
from flocc_lab.experiments.statistics import grouped, middle
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.shipped import read_scenario
from flocc_launch.setup.cache import cache_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURES_SEED = 7
FOCAL_PX = 500.0
NetworkSize = Literal["none", "tiny", "small", "full", "classical", "xfeat-lighterglue", "aliked-lightglue"]
SIZE_PX = (640, 480)
"""Of the pictures whose features are found and matched."""

COUNTS, TIMES = "counts", "times"
LATENT_LOST = "a latent was lost"
SOURCE = "Sec. IV-D, split computation"


class SplitComputeSettings(Settings):
    """Where counts and times come from."""

    run: Path | None = None
    """Run folder whose keyframes and registrations are counted, instead of simulating the scenario."""
    scenario: str = "demo"
    """Scenario that is simulated: a file, or a shipped one."""
    similarities: tuple[float, ...] = (0.1, 0.4, 0.6)
    """Thresholds of place recognition; the paper's permissive one is 0.1."""
    runs: int = Field(1, ge=1, le=100)
    """Repetitions with other seeds."""
    network: NetworkSize = "full"
    """What is timed here: MASt3R (tiny, small, full) with keyed weights, full takes 3 GB of memory; the classical front
    end, or a model of the learned one with its own weights. none: only given times."""
    rounds: int = Field(5, ge=1, le=100)
    """Times that each is measured; the median counts."""
    device: str = "other device"
    """Name of the device whose times are given, such as 'Jetson AGX Xavier'."""
    device_encode_s: float | None = Field(None, gt=0)
    """Seconds to encode one image there, as `flocc bench registration` or the stages of a report say."""
    device_decode_s: float | None = Field(None, gt=0)
    """Seconds to decode one pair there."""

    @model_validator(mode="after")
    def _has_times(self) -> Self:
        if (self.device_encode_s is None) != (self.device_decode_s is None):
            raise ValueError("give both device_encode_s and device_decode_s, or neither")
        if self.network == "none" and self.device_encode_s is None:
            raise ValueError("without a network, device_encode_s and device_decode_s must be given")
        return self


def prepare(settings: SplitComputeSettings, progress: Progress) -> None:
    """Make the scenario's data."""
    if settings.run is None:
        recordings(_scenario(settings, 0.1), progress)


def cells(settings: SplitComputeSettings) -> list[Cell]:
    """A run per threshold, and one measurement of times."""
    counted = (
        [Cell({"part": COUNTS, "similarity": None})]
        if settings.run is not None
        else grid(settings.runs, part=[COUNTS], similarity=settings.similarities)
    )
    timed = [] if settings.network == "none" else [Cell({"part": TIMES, "similarity": None})]
    return [*counted, *timed]


def measure(settings: SplitComputeSettings, cell: Cell, seed: int) -> Row:
    """Count in a run, or measure times."""
    if cell.parameters["part"] == TIMES:
        return measured_times(settings.network, settings.rounds)
    if settings.run is not None:
        return counts(RunFolder.open(settings.run).events())
    scenario = _scenario(settings, cell.parameters["similarity"])
    made = recordings(scenario) if scenario.tracks is None else {}
    return counts(simulated(scenario, seed, made, cache_folder() / "perception").events)


def _scenario(settings: SplitComputeSettings, similarity: float) -> Scenario:
    return read_scenario(settings.scenario, {"core.place_recognition.similarity_threshold": similarity})


def counts(events: Sequence[Reported[Fact]]) -> Row:
    """Keyframes, and the pairs that were registered.

    Raises:
        ExperimentError: Nothing was registered, so nothing can be compared.
    """
    pairs = [(event.robot, event.fact.query, event.fact.match) for event in of_kind(events, ClosureAccepted)]
    rejected = [event for event in of_kind(events, ClosureRejected) if event.fact.reason != LATENT_LOST]
    pairs += [(event.robot, event.fact.query, event.fact.match) for event in rejected]
    if not pairs:
        raise ExperimentError("no pair was registered in this run: its robots do not overlap, or never met")
    return {
        "keyframes": len(of_kind(events, KeyframeTaken)),
        "registrations": len(pairs),
        "keyframes_registered": len({keyframe for _, *both in pairs for keyframe in both}),
        "odometry_pairs": len({(robot, query) for robot, query, _ in pairs}),
    }


def measured_times(network: NetworkSize, rounds: int) -> Row:
    """Median seconds to encode a picture and to decode, or match, a pair on this machine's CPU or GPU.

    Raises:
        FloccError: torch or weights are not there.
    """
    assert network != "none", "the settings say which"
    if network == "classical" or network == "xfeat-lighterglue" or network == "aliked-lightglue":
        return _times_of_features(network, rounds)
    engine, size = keyed_engine(network), SIZES_PX[network]
    pictures = keyed_pictures(size)
    first, second = (engine.place(latent[0].float().cpu().numpy(), size) for latent in engine.encode(pictures))
    engine.decode([(first, second)])
    return {
        "encode_s": median(_seconds(lambda: engine.encode(pictures[:1])) for _ in range(rounds)),
        "decode_s": median(_seconds(lambda: engine.decode([(first, second)])) for _ in range(rounds)),
    }


def _times_of_features(front_end: str, rounds: int) -> Row:
    """The same of a front end with local features: what encoding a picture takes, and registering two latents."""
    skills = build_perception(perception_of(front_end))
    first, second = procedural_images()
    latents = skills.encode(first), skills.encode(second)
    skills.register(*latents, None)
    return {
        "encode_s": median(_seconds(lambda: skills.encode(first)) for _ in range(rounds)),
        "decode_s": median(_seconds(lambda: skills.register(*latents, None)) for _ in range(rounds)),
    }


def procedural_images() -> tuple[Image, Image]:
    """Two views of a generated scene."""
    rng = np.random.default_rng(PICTURES_SEED)
    scene, camera = random_scene(rng), Camera(*SIZE_PX, FOCAL_PX, FOCAL_PX, SIZE_PX[0] / 2, SIZE_PX[1] / 2)
    views = (cv2.resize(random_view(scene, rng), SIZE_PX) for _ in range(2))
    first, second = (Image(np.repeat(view[..., None], 3, axis=2), camera) for view in views)
    return first, second


def _seconds(work: Callable[[], object]) -> float:
    start_s = time.perf_counter()
    work()
    return time.perf_counter() - start_s


def devices_of(settings: SplitComputeSettings, rows: Sequence[Row]) -> dict[str, tuple[float, float]]:
    """Seconds to encode and to decode, by device."""
    found = {f"this machine ({settings.network})": (row["encode_s"], row["decode_s"]) for row in of_part(rows, TIMES)}
    if settings.device_encode_s is not None and settings.device_decode_s is not None:
        found[settings.device] = (settings.device_encode_s, settings.device_decode_s)
    return found


def of_part(rows: Sequence[Row], part: str) -> list[Row]:
    """Rows of counts, or of times."""
    return [row for row in rows if row["part"] == part]


def summarise(settings: SplitComputeSettings, rows: Sequence[Row]) -> Summary:
    """A row per threshold: counts, and the time on every device."""
    devices = devices_of(settings, rows)
    table = [_level(similarity, of_level, devices) for (similarity,), of_level in _levels(rows)]
    return Summary(table, findings(table), notes(devices))


def _levels(rows: Sequence[Row]) -> list[tuple[tuple[float | None], list[Row]]]:
    return [((key[0],), group) for key, group in grouped(of_part(rows, COUNTS), "similarity").items()]


def _level(similarity: float | None, rows: Sequence[Row], devices: dict[str, tuple[float, float]]) -> Row:
    keyframes, registrations, registered, odometry_pairs = (
        middle(rows, name) or 0.0 for name in ("keyframes", "registrations", "keyframes_registered", "odometry_pairs")
    )
    decodes = registrations + odometry_pairs
    row: Row = {
        "similarity_min": similarity,
        "keyframes": keyframes,
        "registrations": registrations,
        "decodes": decodes,
        "encodes_once": keyframes,
        "encodes_once_when_needed": registered,
        "encodes_per_candidate": 2.0 * registrations,
        "encodes_per_inference": 2.0 * decodes,
        "encode_gain": 2.0 * registrations / keyframes,
    }
    for device, (encode_s, decode_s) in devices.items():
        once_s, per_candidate_s = (n * encode_s + decodes * decode_s for n in (keyframes, 2.0 * registrations))
        row |= {f"{device}: once, s": once_s, f"{device}: per candidate, s": per_candidate_s}
        row |= {f"{device}: gain": per_candidate_s / once_s}
    return row


def findings(table: Sequence[Row]) -> list[ExperimentFinding]:
    """Whether encoding once per keyframe computes less, judged at the most permissive threshold, as the paper's."""
    if not table:
        return []
    shown = [
        f"{_at(row)}: {row['encodes_once']:.0f} encodings against {row['encodes_per_candidate']:.0f} for "
        f"{row['registrations']:.0f} registered candidates, {row['encode_gain']:.2f} times"
        for row in table
    ]
    decisive = min(table, key=lambda row: row["similarity_min"] or 0.0)
    claim = f"Encoding once per keyframe computes less than encoding per candidate ({_at(decisive)})"
    return [judged(claim, SOURCE, decisive["encode_gain"] > 1.0, f"{'; '.join(shown)}.")]


def _at(row: Row) -> str:
    return "the run" if row["similarity_min"] is None else f"similarity {row['similarity_min']:g}"


def notes(devices: dict[str, tuple[float, float]]) -> list[str]:
    """What is compared."""
    times = [
        f"{name}: {encode_s:.3f} s to encode, {decode_s:.3f} s to decode."
        for name, (encode_s, decode_s) in devices.items()
    ]
    return [
        "flocc encodes every keyframe when it is taken, also one that no candidate ever needs (encodes_once); "
        "encodes_once_when_needed leaves those out. The paper's baseline encodes both images of every "
        "candidate; encodes_per_inference also encodes both images of every odometry pair.",
        "Decodings are the same on both sides: one per candidate, and one per query keyframe for its odometry pair. "
        "Matching and PnP are not counted.",
        *times,
    ]


def draw(figure: "Figure", settings: SplitComputeSettings, rows: Sequence[Row]) -> None:
    """Numbers of encodings, and the seconds of all encodings and decodings on each device."""
    devices = devices_of(settings, rows)
    table = [_level(similarity, of_level, devices) for (similarity,), of_level in _levels(rows)]
    figure.set_size_inches(4.0 * (1 + len(devices)), 4.0)
    panels = figure.subplots(1, 1 + len(devices), squeeze=False)[0]
    _bars(panels[0], table, "encodes_once", "encodes_per_candidate")
    panels[0].set_ylabel("encodings")
    for panel, device in zip(panels[1:], devices, strict=True):
        _bars(panel, table, f"{device}: once, s", f"{device}: per candidate, s")
        panel.set_ylabel(f"encode and decode, s\n{device}")


def _bars(panel: "Axes", table: Sequence[Row], once: str, per_candidate: str) -> None:
    for k, (column, label) in enumerate(((once, "once per keyframe"), (per_candidate, "per candidate"))):
        at = [place + 0.4 * k - 0.2 for place in range(len(table))]
        panel.bar(at, [row[column] for row in table], 0.38, color=COLOURS[k], label=label)
    labels = ["run" if row["similarity_min"] is None else f"{row['similarity_min']:g}" for row in table]
    panel.set_xticks(range(len(table)), labels)
    panel.set_xlabel("similarity that makes a candidate")
    panel.grid(visible=False, axis="x")
    panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=2, frameon=False)


SPLIT_COMPUTE = Experiment(
    name="split-compute",
    title="encode once per keyframe against encode per candidate",
    settings=SplitComputeSettings,
    quick={"scenario": "meeting", "similarities": (0.6,), "network": "tiny", "rounds": 1},
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
    timed=True,
)
