"""The work that effects ask for: each job takes an effect and returns the event that answers it.

A job runs beside the loop and computes in a worker, so that the loop stays free. It touches neither the core nor the
inbox; whatever fails becomes the event that says so.
"""

import asyncio
import hashlib
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.claims import Claim
from flocc_agent.core.effects import ChooseClosures, Encode, FetchLatent, Optimise, Register, StepConsensus
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
    LatentFetched,
    LatentFetchFailed,
    LatentMissing,
    PairRegistered,
    Withdrawn,
)
from flocc_agent.core.interfaces import Image, ImageWatch, KeyframeLook, OdometryPair, Perception
from flocc_agent.core.own_part import ConsensusProblem, ConsensusStep
from flocc_agent.core.pose_graph import GraphSolution, OptimisationFailed, PoseGraph
from flocc_agent.core.registration import RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.security import RecordSealer
from flocc_agent.runtime.store import Store
from flocc_agent.runtime.transport import Fetched, FetchProblem, Transport
from flocc_agent.runtime.workers import Workers, WorkFailed
from flocc_protocol.ids import KeyframeId

IMAGES_MAX = 8

Job = Encode | FetchLatent | Register | Optimise | ChooseClosures | StepConsensus
"""An effect that takes time and is answered by an event."""


class ImageSlots:
    """Images that wait for the encoder, at most `IMAGES_MAX`."""

    def __init__(self) -> None:
        self._images: dict[int, Image] = {}
        self._count = 0
        self._free = asyncio.Semaphore(IMAGES_MAX)

    def __len__(self) -> int:
        return len(self._images)

    async def put(self, image: Image) -> int:
        """Keep an image, once there is room; gives its number."""
        await self._free.acquire()
        self._count += 1
        self._images[self._count] = image
        return self._count

    @contextmanager
    def taken(self, number: int) -> Iterator[Image]:
        """The image of a number; its slot is free afterwards."""
        try:
            yield self._images[number]
        finally:
            del self._images[number]
            self._free.release()


@dataclass(frozen=True, slots=True, eq=False)
class Tools:
    """What jobs work with.

    Attributes:
        perception: What images are seen with.
        watch: Looks at the robot's own images, one after the other.
        optimise: Pose graph and last solution to a solution; must be importable by a worker process.
        step: One step of this robot's part, in distributed mode; importable like `optimise`.
        workers: Pools off the loop.
        store: Holds latents.
        transport: Fetches latents.
        clock_s: Seconds since the start of the run.
        images: Those that wait for the encoder.
        sealer: Checks signatures, where the swarm has keys; the robot's log then says what its latents are.
    """

    perception: Perception
    watch: ImageWatch
    optimise: Callable[[PoseGraph, GraphSolution | None], GraphSolution | OptimisationFailed]
    step: Callable[[ConsensusProblem], ConsensusStep | OptimisationFailed]
    workers: Workers
    store: Store
    transport: Transport
    clock_s: Callable[[], float]
    images: ImageSlots = field(default_factory=ImageSlots)
    sealer: RecordSealer | None = None


def job_of(effect: Job, tools: Tools) -> Coroutine[Any, Any, Event]:
    """The job that an effect asks for, not yet begun."""
    match effect:
        case Encode():
            return encode(effect, tools)
        case FetchLatent():
            return fetch(effect, tools)
        case Register():
            return register(effect, tools)
        case Optimise():
            return optimise(effect, tools)
        case ChooseClosures():
            return choose(effect, tools)
        case StepConsensus():
            return step(effect, tools)


async def encode(effect: Encode, tools: Tools) -> KeyframeEncoded | KeyframeEncodingFailed:
    """Describe and encode an image; its latent is in the store before the core hears of it."""
    T_odom_camera = pose_from_tq(np.array(effect.T_odom_camera))
    with tools.images.taken(effect.image) as image:
        result = await tools.workers.run("encode", tools.watch.look, tools.perception, image, T_odom_camera)
    if isinstance(result, WorkFailed):
        return KeyframeEncodingFailed(effect.keyframe, result.reason)
    looked = result.value
    withdrawn = await asyncio.to_thread(_withdrawn, effect.keyframe, looked, tools) if looked.withdrawn else None
    if looked.descriptor is None or looked.latent is None:
        return KeyframeEncodingFailed(effect.keyframe, looked.fault, looked.doubts, withdrawn)
    await asyncio.to_thread(tools.store.put_latent, effect.keyframe, looked.latent)
    sha256 = await asyncio.to_thread(_sent_forms, looked.latent, tools)
    return KeyframeEncoded(effect.keyframe, looked.descriptor, looked.doubts, sha256, withdrawn)


def _withdrawn(keyframe: KeyframeId, looked: KeyframeLook, tools: Tools) -> Withdrawn | None:
    """Make latents anew, and tell what they are now."""
    made_anew = hide_in_earlier(keyframe, looked, tools.perception.without, tools.store)
    return withdrawn_by(looked, tuple(_sent_forms(latent, tools) for latent in made_anew))


def withdrawn_by(looked: KeyframeLook, sha256: tuple[bytes, ...] = ()) -> Withdrawn | None:
    """What a look takes back: for good where no latent could be made anew."""
    return Withdrawn(looked.withdrawn, sha256, is_final=looked.hidden is None) if looked.withdrawn else None


class KeepsLatents(Protocol):
    """What keeps latents by keyframe."""

    def latent(self, keyframe: KeyframeId, /) -> bytes | None:
        """Give a latent, None where there is none."""
        ...

    def replace_latent(self, keyframe: KeyframeId, latent: bytes, /) -> None:
        """Keep another latent in the place of one that is there, where one is."""
        ...

    def put_latent(self, keyframe: KeyframeId, latent: bytes, /) -> None:
        """Keep a latent, where there is none."""
        ...


def keep_fetched(keyframe: KeyframeId, latent: bytes, store: KeepsLatents) -> None:
    """Keep what a fetch brought, also where an older one is, from before its owner made it anew."""
    store.replace_latent(keyframe, latent)
    store.put_latent(keyframe, latent)


def hide_in_earlier(
    keyframe: KeyframeId,
    looked: KeyframeLook,
    without: Callable[[bytes, NDArray[np.bool_]], bytes],
    store: KeepsLatents,
) -> list[bytes]:
    """Take what moves with the camera out of the latents that were encoded before it was known.

    Args:
        keyframe: With which it became known.
        looked: Its look, which says what that is, and how many keyframes show it.
        without: Takes what is hidden out of a latent.
        store: Where they are.

    Returns:
        The latents as they are now, of all keyframes that are withdrawn; b"" where there is none.
    """
    if looked.hidden is None:
        return []
    made: list[bytes] = []
    for index in range(max(0, keyframe.index - looked.withdrawn), keyframe.index):
        earlier = KeyframeId(keyframe.log, index)
        latent = store.latent(earlier)
        made.append(b"" if latent is None else without(latent, looked.hidden))
        if latent is not None:
            store.replace_latent(earlier, made[-1])
    return made


def _sent_forms(latent: bytes, tools: Tools) -> bytes:
    """Hashes of what is sent of a latent: itself, and where there is one the picture in its place.

    Empty where there is none, or where the swarm has no keys.
    """
    if not latent or tools.sealer is None:
        return b""
    perception = tools.perception
    forms = dict.fromkeys(perception.part(latent, encode_bytes) for encode_bytes in (None, 0))
    return b"".join(hashlib.sha256(form).digest() for form in forms)


async def fetch(effect: FetchLatent, tools: Tools) -> LatentFetched | LatentFetchFailed:
    """Bring a latent of another robot into the store."""
    keyframe, holder = effect.keyframe, effect.holder
    encode_s, began_s = tools.perception.encode_s(), tools.clock_s()
    answer = await tools.transport.fetch_latent(holder, str(keyframe), effect.deadline_s, encode_s=encode_s)
    if not isinstance(answer, Fetched):
        return LatentFetchFailed(keyframe, holder, answer.problem.value)
    if effect.named is not None and not effect.named.names(hashlib.sha256(answer.latent).digest()):
        return LatentFetchFailed(keyframe, holder, FetchProblem.WRONG_HASH.value)
    tools.workers.stages.observe("fetch", tools.clock_s() - began_s)
    await asyncio.to_thread(keep_fetched, keyframe, answer.latent, tools.store)
    return LatentFetched(keyframe, holder)


async def register(effect: Register, tools: Tools) -> PairRegistered | LatentMissing:
    """Register two latents of the store, with the query's odometry pair for Eqs. (1) and (6)."""
    keyframes = (effect.query, effect.match, effect.neighbour)
    query, match, neighbour = await asyncio.to_thread(lambda: [tools.store.latent(k) for k in keyframes])
    if query is None or match is None or neighbour is None:
        return LatentMissing(effect.pair, keyframes[[query, match, neighbour].index(None)])
    T_neighbour_query = pose_from_tq(np.array(effect.T_neighbour_query))
    pair = OdometryPair(neighbour, T_neighbour_query, f"{effect.neighbour} {effect.query}")
    result = await tools.workers.run("register", tools.perception.register, query, match, pair)
    if isinstance(result, WorkFailed):
        return PairRegistered(effect.pair, RegistrationFailed(RegistrationFailure.CRASHED, result.reason))
    return PairRegistered(effect.pair, result.value)


async def optimise(effect: Optimise, tools: Tools) -> GraphOptimised | GraphOptimisationFailed:
    """Optimise a pose graph in the solver's process."""
    result = await tools.workers.run("optimise", tools.optimise, effect.graph, effect.initial)
    solution = result if isinstance(result, WorkFailed) else result.value
    if isinstance(solution, (WorkFailed, OptimisationFailed)):
        return GraphOptimisationFailed(effect.term, effect.round, solution.reason)
    return GraphOptimised(effect.term, effect.round, solution)


async def check(messages: Sequence[Sequence[Claim]], tools: Tools) -> list[int]:
    """Look at the signatures of messages in a worker; gives how many of each. The robot does what is left."""
    assert tools.sealer is not None
    result = await tools.workers.run("check", tools.sealer.check, messages)
    return [len(claims) for claims in messages] if isinstance(result, WorkFailed) else result.value


async def choose(effect: ChooseClosures, tools: Tools) -> ClosuresChosen | ChoiceFailed:
    """Solve one or two logs for themselves in the solver's process."""
    result = await tools.workers.run("optimise", tools.optimise, effect.graph, None)
    solution = result if isinstance(result, WorkFailed) else result.value
    if isinstance(solution, (WorkFailed, OptimisationFailed)):
        return ChoiceFailed(effect.number, solution.reason)
    return ClosuresChosen(effect.number, solution)


async def step(effect: StepConsensus, tools: Tools) -> ConsensusStepped | ConsensusStepFailed:
    """Do a step of the own part in the solver's process."""
    result = await tools.workers.run("optimise", tools.step, effect.problem)
    done = result if isinstance(result, WorkFailed) else result.value
    if isinstance(done, (WorkFailed, OptimisationFailed)):
        return ConsensusStepFailed(effect.number, done.reason)
    return ConsensusStepped(effect.number, done)
