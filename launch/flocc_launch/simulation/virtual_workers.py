"""Simulated workers: real perception and optimisation, whose answers come after a drawn time.

Each robot has one encoder, one registrar and one optimiser. Results are computed when they are due, so a robot that
dies meanwhile costs nothing; they never depend on how long they took.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.effects import ChooseClosures, Optimise, Register, StepConsensus
from flocc_agent.core.events import (
    ChoiceFailed,
    ClosuresChosen,
    ConsensusStepFailed,
    ConsensusStepped,
    Event,
    GraphOptimisationFailed,
    GraphOptimised,
    KeyframeEncoded,
    KeyframeEncodingFailed,
    LatentMissing,
    PairRegistered,
)
from flocc_agent.core.interfaces import KeyframeLook, OdometryPair
from flocc_agent.core.own_part import ConsensusProblem, ConsensusStep
from flocc_agent.core.pose_graph import GraphSolution, OptimisationFailed, PoseGraph
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.jobs import hide_in_earlier, withdrawn_by
from flocc_agent.stages import StageTimes
from flocc_launch.simulation.disk import Disk
from flocc_launch.simulation.overlays import Overlay
from flocc_launch.simulation.virtual_playback import Capture
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]
Optimiser = Callable[[PoseGraph, GraphSolution | None], GraphSolution | OptimisationFailed]
ConsensusStepper = Callable[[ConsensusProblem], ConsensusStep | OptimisationFailed]


class CaptureWatch(Protocol):
    """Looks at one robot's captures, in the order in which they were taken."""

    def look(self, capture: Capture, T_odom_camera: Float) -> KeyframeLook:
        """Describe and encode a keyframe, and tell what is odd about the camera."""
        ...


class Eyes(Protocol):
    """Perception as the simulation needs it."""

    def watch(self, hidden: Mask | None) -> CaptureWatch:
        """What looks at one robot's captures; `hidden` are (H, W) pixels that move with its camera."""
        ...

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's."""
        ...

    def without(self, latent: bytes, hidden: Mask) -> bytes:
        """Give a latent without what is hidden, (H, W)."""
        ...


@dataclass(frozen=True, slots=True)
class WorkTimes:
    """How long workers take, drawn uniformly between half and one and a half of these."""

    encode_s: float = 0.1
    register_s: float = 0.25
    optimise_s: float = 0.15
    step_s: float = 0.05


class VirtualWorkers:
    """The workers of one robot.

    Attributes:
        slowness: Factor on every duration.
        overlay: Something that gets onto the camera at times; None: nothing does.
        stages: How long what was asked of them takes, on virtual time.
    """

    def __init__(
        self,
        eyes: Eyes,
        optimiser: Optimiser,
        stepper: ConsensusStepper,
        times: WorkTimes,
        rng: np.random.Generator,
        hidden: Mask | None = None,
    ) -> None:
        self.slowness = 1.0
        self.overlay: Overlay | None = None
        self.stages = StageTimes()
        self._eyes = eyes
        self._hidden = hidden
        self._watch = eyes.watch(hidden)
        self._optimiser = optimiser
        self._stepper = stepper
        self._times = times
        self._rng = rng
        self._encoder_free_s = 0.0

    def encoded_at_s(self, now_s: float) -> float:
        """When the encoder, which takes one image after the other, is done with one more."""
        self.stages.observe("encode_wait", max(self._encoder_free_s - now_s, 0.0))
        self._encoder_free_s = max(now_s, self._encoder_free_s) + self._lasts("encode", self._times.encode_s)
        return self._encoder_free_s

    def registered_at_s(self, now_s: float) -> float:
        """When a registration that starts now is done."""
        return now_s + self._lasts("register", self._times.register_s)

    def optimised_at_s(self, now_s: float) -> float:
        """When an optimisation that starts now is done."""
        return now_s + self._lasts("optimise", self._times.optimise_s)

    def stepped_at_s(self, now_s: float) -> float:
        """When a step of the own part that starts now is done."""
        return now_s + self._lasts("step", self._times.step_s)

    def restart(self) -> None:
        """Forget the queue, and what the camera was like."""
        self._encoder_free_s = 0.0
        self._watch = self._eyes.watch(self._hidden)

    def encode(self, keyframe: KeyframeId, capture: Capture, T_odom_camera: Pose7, disk: Disk) -> Event:
        """Describe and encode an image, and store the latent."""
        try:
            looked = self._watch.look(capture, pose_from_tq(np.array(T_odom_camera)))
        except FloccError as error:
            return KeyframeEncodingFailed(keyframe, str(error))
        without = self._eyes.without
        if self.overlay is not None:
            looked, without = self.overlay.look(keyframe, looked), self.overlay.without
        hide_in_earlier(keyframe, looked, without, disk)
        withdrawn = withdrawn_by(looked)
        if looked.descriptor is None or looked.latent is None:
            return KeyframeEncodingFailed(keyframe, looked.fault, looked.doubts, withdrawn)
        disk.put_latent(keyframe, looked.latent)
        return KeyframeEncoded(keyframe, looked.descriptor, looked.doubts, withdrawn=withdrawn)

    def register(self, job: Register, disk: Disk) -> Event:
        """Register a pair, or say which latent is missing."""
        latents: list[bytes] = []
        for keyframe in (job.query, job.match, job.neighbour):
            latent = disk.latent(keyframe)
            if latent is None:
                return LatentMissing(job.pair, keyframe)
            latents.append(latent)
        query, match, neighbour = latents
        T_neighbour_query = pose_from_tq(np.array(job.T_neighbour_query))
        odometry = OdometryPair(neighbour, T_neighbour_query, f"{job.neighbour} {job.query}")
        try:
            return PairRegistered(job.pair, self._eyes.register(query, match, odometry))
        except Exception as error:  # as in the real workers, a failure is an event
            logger.error("registering %s with %s failed", job.query, job.match, exc_info=True)
            return PairRegistered(job.pair, RegistrationFailed(RegistrationFailure.CRASHED, str(error)))

    def optimise(self, job: Optimise) -> Event:
        """Optimise a pose graph; how long it really took is nobody's business on virtual time."""
        try:
            solution = self._optimiser(job.graph, job.initial)
        except Exception as error:  # as in the real workers, a failure is an event
            logger.error("round %d of %s failed", job.round, job.term, exc_info=True)
            return GraphOptimisationFailed(job.term, job.round, str(error).strip().split("\n")[0])
        if isinstance(solution, OptimisationFailed):
            return GraphOptimisationFailed(job.term, job.round, solution.reason)
        return GraphOptimised(job.term, job.round, replace(solution, solve_s=0.0, timings_s={}))

    def choose(self, job: ChooseClosures) -> Event:
        """Solve one or two logs for themselves."""
        try:
            solution = self._optimiser(job.graph, None)
        except Exception as error:  # as in the real workers, a failure is an event
            logger.error("choice %d failed", job.number, exc_info=True)
            return ChoiceFailed(job.number, str(error).strip().split("\n")[0])
        if isinstance(solution, OptimisationFailed):
            return ChoiceFailed(job.number, solution.reason)
        return ClosuresChosen(job.number, replace(solution, solve_s=0.0, timings_s={}))

    def step(self, job: StepConsensus) -> Event:
        """Do one step of a robot's part."""
        done = self._stepper(job.problem)
        if isinstance(done, OptimisationFailed):
            return ConsensusStepFailed(job.number, done.reason)
        return ConsensusStepped(job.number, done)

    def _lasts(self, stage: str, typical_s: float) -> float:
        lasts_s = self.slowness * typical_s * float(self._rng.uniform(0.5, 1.5))
        self.stages.observe(stage, lasts_s)
        return lasts_s
