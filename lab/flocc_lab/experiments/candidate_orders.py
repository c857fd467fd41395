"""`flocc experiment candidate-order`: how many closures it takes to become accurate, by the order of candidates.

Robots explore apart and then meet, with links that carry a few latents a minute: hundreds of candidates wait, and which
is first decides. The run is simulated once per order; then the real back end solves the whole graph with the first
closures only, as many as there were then, so that all points of a curve are about the same trajectories.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flocc_agent.backend import optimise_graph
from flocc_agent.config import BackendConfig, KeyframeConfig, PerceptionConfig, RadioConfig, SyntheticConfig
from flocc_agent.core.parameters import (
    CoreParameters,
    LoopClosingParameters,
    PlaceRecognitionParameters,
    RoundParameters,
)
from flocc_agent.core.pose_graph import LoopClosure, OptimisationFailed, PoseGraph
from flocc_agent.core.reports import CandidateFound, ClosureAccepted, ClosureRejected
from flocc_agent.runtime.event_lines import of_kind
from flocc_lab.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentFinding,
    Row,
    Settings,
    Summary,
    grid,
    judged,
)
from flocc_lab.experiments.plots import COLOURS, from_zero
from flocc_lab.experiments.statistics import grouped, middle, values
from flocc_launch.runs.trajectory_errors import ate_m
from flocc_launch.scenarios.scenario import Scenario, SimulationScenario, TracksScenario
from flocc_launch.simulation.simulate import playbacks_of, swarm_of
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_playback import Playback
from flocc_protocol.ids import KeyframeId
from flocc_protocol.messages import CandidatePair

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Float = NDArray[np.float64]
Order = Literal["similarity", "spectral"]

ORDERS: tuple[Order, ...] = ("similarity", "spectral")
LATENCY_S = 0.02
TARGET = "flocc's own, after Swarm-SLAM"
SHARE_WANTED = 0.5
"""Spectral order is to need at most this share of the closures."""


class CandidateOrderSettings(Settings):
    """The swarm, its links, and how long it has."""

    robots: int = Field(5, ge=2, le=16)
    """Robots."""
    area_m: float = Field(60.0, gt=0)
    """Edge of the square town."""
    length_m: float = Field(240.0, gt=0)
    """Length of each walk."""
    keyframe_distance_m: float = Field(2.0, gt=0)
    """Distance between keyframes."""
    bandwidth_bytes_s: float = Field(125_000.0, gt=0)
    """Budget of each robot, and capacity of each link; 125 kB/s are 1 Mbit/s."""
    latent_bytes: int = Field(1_500_000, ge=0)
    """Size of a latent; MASt3R's are 1.5 MB."""
    meeting_s: float = Field(300.0, gt=0)
    """How long the robots are together after they explored."""
    similarity_min: float = Field(0.5, ge=-1, le=1)
    """Threshold of candidates."""
    closures: tuple[int, ...] = (8, 12, 16, 20, 24, 28, 32, 40, 48, 64, 80, 96)
    """Numbers of closures at which the graph is solved."""
    runs: int = Field(7, ge=1, le=100)
    """Repetitions with other walks, drift and perception."""

    @property
    def apart_s(self) -> float:
        """How long the robots explore on their own."""
        return self.length_m / TracksScenario().speed_m_s


def cells(settings: CandidateOrderSettings) -> list[Cell]:
    """Both orders of each run."""
    return grid(settings.runs, order=ORDERS)


def measure(settings: CandidateOrderSettings, cell: Cell, seed: int) -> Row:
    """Simulate one swarm and solve its graph with more and more closures."""
    given = scenario(settings, cell.parameters["order"], seed)
    playbacks = playbacks_of(given, {})
    swarm = swarm_of(given, playbacks, seed)
    assert given.duration_s is not None
    swarm.run_until(given.duration_s)
    graph, closures, times_s = registered(swarm)
    counts = sorted({*(n for n in settings.closures if n < len(closures)), len(closures)})
    rejected = {(told.fact.query, told.fact.match) for told in of_kind(swarm.told, ClosureRejected)}
    received = [swarm.network.traffic[name].received["latent"] for name in sorted(playbacks)]
    return {
        "closures": len(closures),
        "rejected": len(rejected),
        "candidates": len(of_kind(swarm.told, CandidateFound)),
        "latent_bytes_received": sum(received),
        "curve": [[n, ate_of(PoseGraph(graph.trajectories, closures[:n]), playbacks)] for n in counts],
        "after_s": [[n, round(times_s[n - 1] - settings.apart_s, 1)] for n in counts if n],
        "odometry_m": ate_of(PoseGraph(graph.trajectories), playbacks, joined=False),
    }


def scenario(settings: CandidateOrderSettings, order: Order, seed: int) -> Scenario:
    """Explore apart, then meet."""
    tracks = TracksScenario(robots=settings.robots, seed=seed, area_m=settings.area_m, length_m=settings.length_m)
    alone = tuple((f"r{k + 1}",) for k in range(settings.robots))
    radio: dict[str, Any] = {
        "latency_s": LATENCY_S,
        "bandwidth_bytes_s": settings.bandwidth_bytes_s,
        "partitions": ({"groups": alone, "to_s": settings.apart_s},),
    }
    slow_s = 4 * settings.latent_bytes / settings.bandwidth_bytes_s
    return Scenario(
        name="candidate-order",
        seed=seed,
        duration_s=settings.apart_s + settings.meeting_s,
        tracks=tracks,
        keyframes=KeyframeConfig(distance_m=settings.keyframe_distance_m, rotation_rad=1.0),
        radio=RadioConfig.model_validate(radio),
        bandwidth_bytes_s=settings.bandwidth_bytes_s,
        perception=PerceptionConfig(method="synthetic", synthetic=SyntheticConfig(latent_bytes=settings.latent_bytes)),
        core=CoreParameters(
            place_recognition=PlaceRecognitionParameters(
                similarity_threshold=settings.similarity_min, candidate_order=order
            ),
            loop_closing=LoopClosingParameters(fetch_timeout_s=max(10.0, slow_s)),
            rounds=RoundParameters(period_s=10.0),
        ),
        simulation=SimulationScenario(optimiser="quick"),
    )


def registered(swarm: Swarm) -> tuple[PoseGraph, list[LoopClosure], list[float]]:
    """The graph of whoever knows most, its closures in the order in which they were registered, and when they were."""
    cores = [station.core for station in swarm.running() if station.core is not None]
    knows = max(cores, key=lambda core: core.assembly.closures)
    graph = knows.assembly.graph()
    first: dict[tuple[KeyframeId, KeyframeId], float] = {}
    for told in of_kind(swarm.told, ClosureAccepted):
        first.setdefault((told.fact.query, told.fact.match), round(told.t, 6))
    by_pair = {CandidatePair.of(c.query, c.match): c for c in graph.closures}
    times = {pair: first[c.query, c.match] for pair, c in by_pair.items()}
    ordered = sorted(by_pair, key=lambda pair: (times[pair], pair))
    return graph, [by_pair[pair] for pair in ordered], [times[pair] for pair in ordered]


def ate_of(graph: PoseGraph, playbacks: dict[str, Playback], joined: bool = True) -> float | None:
    """Joint ATE of all keyframes after optimisation, None while the robots are not in one map.

    Args:
        graph: What is solved.
        playbacks: The truth.
        joined: False aligns each map on its own instead, for odometry.
    """
    solution = optimise_graph(BackendConfig(covariances=False), graph, None)
    if isinstance(solution, OptimisationFailed) or (joined and len(solution.components) > 1):
        return None
    errors, counts = [], []
    for component in solution.components:
        logs = component.logs
        truths = [true_poses(playbacks[log.robot], len(component.T_map_keyframe[log])) for log in logs]
        error = ate_m([component.T_map_keyframe[log] for log in logs], truths)
        if error is not None:
            errors.append(error)
            counts.append(sum(len(truth) for truth in truths))
    return float(np.sqrt(np.average(np.square(errors), weights=counts)))


def true_poses(playback: Playback, count: int) -> Float:
    """Where the camera truly was at its first keyframes, (N, 4, 4)."""
    assert playback.truth is not None
    found = [playback.truth.at(capture.stamp_s) for capture in playback.captures[:count]]
    return np.array([T for T in found if T is not None]) @ playback.T_body_camera


def summarise(_settings: CandidateOrderSettings, rows: Sequence[Row]) -> Summary:
    """Medians over the runs at each number of closures, and what one order needs for the other's accuracy."""
    table = [_level(order, n, [row for row in rows if row["order"] == order]) for n in levels(rows) for order in ORDERS]
    notes = ["No ATE is given while the robots are in several maps.", *(_note(*share) for share in shares_of(rows))]
    return Summary(table, findings(rows), notes)


def levels(rows: Sequence[Row]) -> list[int]:
    """Numbers of closures that every run reached, so that all medians are over the same runs."""
    reached_by = [{n for n, _ in row["curve"][:-1]} for row in rows]
    return sorted(set.intersection(*reached_by)) if reached_by else []


def _level(order: str, n: int, rows: Sequence[Row]) -> Row:
    known = [{"ate_m": dict(row["curve"]).get(n), "after_s": dict(row["after_s"]).get(n)} for row in rows]
    return {
        "order": order,
        "closures": n,
        "after_s": middle(known, "after_s"),
        "runs": len(values(known, "after_s")),
        "in_one_map": len(values(known, "ate_m")),
        "ate_m": middle(known, "ate_m"),
    }


def shares_of(rows: Sequence[Row]) -> list[tuple[int, float | None, float | None]]:
    """Per run, what spectral order needs for the accuracy that similarity order has at its end, within 5 %.

    Returns:
        Run, and its closures over all that similarity order spent, and over the first so many with which that was as
        good. None where spectral order never gets there, and no entry where similarity order ends in several maps.
    """
    shares: list[tuple[int, float | None, float | None]] = []
    for (run,), pair in grouped(rows, "run").items():
        curves = {row["order"]: row["curve"] for row in pair}
        if set(curves) != set(ORDERS) or curves["similarity"][-1][1] is None:
            continue
        spent, error = curves["similarity"][-1]
        first = reached(curves["similarity"], TOLERANCE * error)
        needed = reached(curves["spectral"], TOLERANCE * error)
        assert first is not None
        shares.append((run, None, None) if needed is None else (run, needed / spent, needed / first))
    return shares


TOLERANCE = 1.05


def reached(curve: Sequence[Sequence[Any]], limit: float) -> int | None:
    """The least number of closures from which on the error stays within a limit."""
    least = None
    for n, error in reversed(curve):
        if error is None or error > limit:
            break
        least = n
    return least


def _note(run: int, of_all: float | None, of_first: float | None) -> str:
    if of_all is None:
        return f"Run {run}: spectral order did not reach the accuracy of similarity order."
    return f"Run {run}: {of_all:.2f} of the closures that were spent, {of_first:.2f} of the first that sufficed."


def findings(rows: Sequence[Row]) -> list[ExperimentFinding]:
    """The target, and the same against the first closures with which similarity order was as good as at its end."""
    shares = shares_of(rows)
    if not shares:
        return []
    of_all, of_first = ([infinite(share[k]) for share in shares] for k in (1, 2))
    claim = "Under a budget, spectral order reaches the accuracy of similarity order with at most half the closures"
    harder = f"{claim} with which that was first as good"
    return [
        judged(claim, TARGET, float(np.median(of_all)) <= SHARE_WANTED, _spread(of_all)),
        judged(harder, TARGET, float(np.median(of_first)) <= SHARE_WANTED, _spread(of_first)),
    ]


def infinite(share: float | None) -> float:
    """A share for medians: never is more than any."""
    return float("inf") if share is None else share


def _spread(shares: Sequence[float]) -> str:
    return f"Median share {np.median(shares):.2f} over {len(shares)} runs, from {min(shares):.2f} to {max(shares):.2f}."


def draw(figure: "Figure", _settings: CandidateOrderSettings, rows: Sequence[Row]) -> None:
    """Error over closures and over time: runs thin, medians thick; runs that never end in one map are not drawn."""
    left, right = figure.subplots(1, 2, sharey=True)
    shown: list[float] = []
    for k, order in enumerate(ORDERS):
        mine = [row for row in rows if row["order"] == order]
        for row in mine:
            after_s = dict(row["after_s"])
            known = [(n, after_s[n], error) for n, error in row["curve"] if error is not None]
            if known:
                counts, times_s, errors = zip(*known, strict=True)
                left.plot(counts, errors, color=COLOURS[k], alpha=0.25, linewidth=0.8)
                right.plot(times_s, errors, color=COLOURS[k], alpha=0.25, linewidth=0.8)
        medians = [level for n in levels(rows) if (level := _level(order, n, mine))["ate_m"] is not None]
        middles = [level["ate_m"] for level in medians]
        thick = {"color": COLOURS[k], "marker": "o", "markersize": 4, "label": f"{order} order"}
        left.plot([level["closures"] for level in medians], middles, **thick)
        right.plot([level["after_s"] for level in medians], middles, **thick)
        shown += middles
    left.set_xlabel("closures registered")
    left.set_ylabel("joint ATE, m")
    right.set_xlabel("time since the robots met, s")
    from_zero(left, shown)
    left.legend()


CANDIDATE_ORDER = Experiment(
    name="candidate-order",
    title="closures to accuracy under a bandwidth budget, by the order of candidates",
    settings=CandidateOrderSettings,
    quick={"robots": 3, "area_m": 20.0, "length_m": 60.0, "latent_bytes": 150_000, "bandwidth_bytes_s": 30_000.0,
           "meeting_s": 60.0, "closures": (4, 8, 16), "runs": 1},
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
)  # fmt: skip
