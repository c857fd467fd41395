"""A pose graph optimised by all its robots together with RBCD, on virtual time: machines, and links that lose.

Nothing of the optimisation is here, only who hears what and when.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import between, inverse
from flocc_lab.rbcd.block import isotropic_weights, iterate_block
from flocc_lab.rbcd.block_descent import lifted, squared_residuals
from flocc_lab.rbcd.blocks import BlockStep
from flocc_lab.rbcd.machine import Effect, IterateBlock, RbcdMachine, RbcdParameters
from flocc_lab.rbcd.separators import Separators, decoded, encoded
from flocc_launch.simulation.agenda import Agenda
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

LATENCY_S = 0.01
ITERATION_S = 0.05
OnIteration = Callable[[int, Mapping[LogId, Float]], bool]
"""Takes the number of iterations of the slowest robot and everybody's poses; True ends the run."""


@dataclass(slots=True)
class RbcdTraffic:
    """What was said: messages and bytes, by all robots."""

    messages: int = 0
    payload_bytes: int = 0


@dataclass(slots=True)
class DistributedRun:
    """Robots that optimise one graph together.

    Attributes:
        T_map_keyframe: Poses of each robot after its last iteration, in the frame of its anchor.
        anchors: The frame of each robot.
        iterations: Iterations of each robot.
        traffic: What was said.
        end_s: Virtual time at the end.
        is_settled: Everybody rested at the end.
        rejected: Closures between or within robots with robust weight zero.
    """

    T_map_keyframe: dict[LogId, Float] = field(default_factory=dict)
    anchors: dict[LogId, LogId] = field(default_factory=dict)
    iterations: dict[LogId, int] = field(default_factory=dict)
    traffic: RbcdTraffic = field(default_factory=RbcdTraffic)
    end_s: float = 0.0
    is_settled: bool = False
    rejected: int = 0


def optimise_together(
    graph: PoseGraph,
    config: BackendConfig,
    parameters: RbcdParameters,
    *,
    loss_ratio: float = 0.0,
    seed: int = 0,
    iterations_max: int = 1000,
    on_iteration: OnIteration = lambda _number, _poses: False,
) -> DistributedRun:
    """Let one machine per robot optimise a graph until all rest.

    Args:
        graph: Odometry and closures; every robot reads only what concerns it.
        config: Noise model and solver.
        parameters: Rates and tolerance of the machines.
        loss_ratio: Share of messages that each receiver does not get.
        seed: Of the losses.
        iterations_max: The run ends when the slowest robot has done so many.
        on_iteration: Looks at the poses whenever the slowest robot has done one more; True ends the run.
    """
    return _Air(graph, config, parameters, loss_ratio, seed).run(iterations_max, on_iteration)


class _Air:
    """Machines and what is between them."""

    def __init__(
        self, graph: PoseGraph, config: BackendConfig, parameters: RbcdParameters, loss_ratio: float, seed: int
    ) -> None:
        self._machines = {log: RbcdMachine(log, graph, parameters) for log in sorted(graph.trajectories)}
        self._config = config
        self._loss_ratio = loss_ratio
        self._rng = np.random.default_rng(seed)
        self._agenda = Agenda()
        self._run = DistributedRun()
        self._rejected = dict.fromkeys(self._machines, 0)
        self._ends = False

    def run(self, iterations_max: int, on_iteration: OnIteration) -> DistributedRun:
        done = 0
        for log in self._machines:
            self._wake(log)
        while not self._ends and not self._rests() and done < iterations_max:
            self._agenda.run_until(self._agenda.now_s + LATENCY_S)
            slowest = min(machine.iteration for machine in self._machines.values())
            if slowest > done and len(self._run.T_map_keyframe) == len(self._machines):
                done = slowest
                self._ends = on_iteration(done, self._run.T_map_keyframe)
        self._run.is_settled = self._rests()
        self._run.end_s = self._agenda.now_s
        self._run.rejected = sum(self._rejected.values())
        self._run.anchors = {log: machine.anchor for log, machine in self._machines.items()}
        self._run.iterations = {log: machine.iteration for log, machine in self._machines.items()}
        return self._run

    def _rests(self) -> bool:
        begun = all(machine.iteration > 0 for machine in self._machines.values())
        return begun and all(m.is_settled and m.deadline() > self._agenda.now_s + 1.0 for m in self._machines.values())

    def _wake(self, log: LogId) -> None:
        machine, now = self._machines[log], self._agenda.now_s
        self._carry_out(log, machine.tick(now))
        due_s = machine.deadline()
        if due_s < float("inf"):
            self._agenda.at(max(due_s, now + 1e-3), partial(self._wake_if_due, log))

    def _wake_if_due(self, log: LogId) -> None:
        if self._machines[log].deadline() <= self._agenda.now_s:
            self._wake(log)

    def _carry_out(self, log: LogId, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Separators():
                    self._send(log, effect)
                case IterateBlock(number, problem):
                    step = iterate_block(self._config, problem)
                    assert isinstance(step, BlockStep), f"{log}: {step}"
                    self._agenda.at(self._agenda.now_s + ITERATION_S, partial(self._iterated, log, number, step))

    def _iterated(self, log: LogId, number: int, step: BlockStep) -> None:
        self._run.T_map_keyframe[log] = step.T_map_keyframe
        self._rejected[log] = step.rejected
        self._carry_out(log, self._machines[log].on_step(number, step, self._agenda.now_s))
        self._wake(log)

    def _send(self, log: LogId, message: Separators) -> None:
        """Through the real codec, to everybody who does not lose it."""
        payload = encoded(log, message)
        self._run.traffic.messages += 1
        self._run.traffic.payload_bytes += len(payload)
        for other in self._machines:
            if other != log and self._rng.random() >= self._loss_ratio:
                self._agenda.at(self._agenda.now_s + LATENCY_S, partial(self._hear, other, log, decoded(payload)))

    def _hear(self, log: LogId, sender: LogId, message: Separators) -> None:
        self._machines[log].on_separators(sender, message)
        self._wake(log)


def cut_by_time(graph: PoseGraph, robots: int) -> PoseGraph:
    """Give the keyframes of a graph of one robot, in equal parts, to several; odometry over a cut becomes a closure.

    Raises:
        ValueError: The graph is not one robot's, or has fewer keyframes than robots.
    """
    if len(graph.trajectories) != 1 or sum(map(len, graph.trajectories.values())) < robots:
        raise ValueError(f"only one robot's graph of at least {robots} keyframes can be cut among {robots}")
    (trajectory,) = graph.trajectories.values()
    T, covariances = np.asarray(trajectory.T_odom_keyframe), np.asarray(trajectory.edge_covariances)
    cuts = np.linspace(0, len(T), robots + 1).astype(int)
    logs = [LogId(f"r{k + 1}") for k in range(robots)]

    def owned(index: int) -> KeyframeId:
        k = int(np.searchsorted(cuts, index, side="right") - 1)
        return KeyframeId(logs[k], index - int(cuts[k]))

    parts = {
        log: Trajectory(T[a:b], covariances[a : b - 1]) for log, a, b in zip(logs, cuts[:-1], cuts[1:], strict=True)
    }
    over_cuts = [
        LoopClosure(owned(b - 1), owned(b), between(T[b - 1], T[b]), covariance=covariances[b - 1], metric=True)
        for b in cuts[1:-1].tolist()
    ]
    closures = [replace(c, query=owned(c.query.index), match=owned(c.match.index)) for c in graph.closures]
    return PoseGraph(parts, [*closures, *over_cuts])


def graph_cost(graph: PoseGraph, T_map_keyframe: Mapping[LogId, Float]) -> float:
    """SE-Sync's objective of metric graphs with isotropic covariances: every odometry edge and closure counts."""
    total = 0.0
    for log, trajectory in graph.trajectories.items():
        T_odom = np.asarray(trajectory.T_odom_keyframe)
        kappa, tau = isotropic_weights(np.asarray(trajectory.edge_covariances))
        total += _cost(T_map_keyframe[log][:-1], T_map_keyframe[log][1:], inverse(T_odom[:-1]) @ T_odom[1:], kappa, tau)
    T_i = np.array([T_map_keyframe[c.query.log][c.query.index] for c in graph.closures]).reshape(-1, 4, 4)
    T_j = np.array([T_map_keyframe[c.match.log][c.match.index] for c in graph.closures]).reshape(-1, 4, 4)
    T = np.array([c.T_query_match_unscaled for c in graph.closures]).reshape(-1, 4, 4)
    kappa, tau = isotropic_weights(np.array([c.covariance for c in graph.closures]).reshape(-1, 6, 6))
    return total + _cost(T_i, T_j, T, kappa, tau)


def _cost(T_i: Float, T_j: Float, T: Float, kappa: Float, tau: Float) -> float:
    return float(np.sum(squared_residuals(lifted(T_i, 3), lifted(T_j, 3), T, kappa, tau)))
