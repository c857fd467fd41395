"""Work off the event loop, so that heartbeats are on time whatever else a robot computes.

Threads run what releases the interpreter lock or is plain Python (OpenCV, torch); a process of its own runs what holds
the lock for long (GTSAM). The process is started at its first task, ends when it has been idle for a while, when it is
no longer needed, and when its parent dies in whatever way. Every queue is bounded.

This is the only module that catches `Exception`: the failure of a task is logged with its traceback and returned.
"""

import asyncio
import ctypes
import logging
import os
import pickle
import signal
import struct
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, BinaryIO, Generic, TypeVar

from flocc_agent.runtime.freed_memory import give_back
from flocc_agent.stages import StageTimes, Timed, timed

logger = logging.getLogger(__name__)

T = TypeVar("T")

THREADS = {"encode": 1, "register": 1, "check": 1}
PROCESS_KINDS = frozenset({"optimise"})
LENGTH = struct.Struct(">Q")
NICENESS = 5
STOP_TIMEOUT_S = 2.0
GIVE_BACK_S = 1.0
"""So long after a task of a process whoever asked has taken what he wants of it, and the rest is given back."""
PR_SET_PDEATHSIG = 1
"""prctl(2): the signal that this process gets when its parent dies."""


@dataclass(frozen=True, slots=True)
class Ok(Generic[T]):
    """What a task returned."""

    value: T


@dataclass(frozen=True, slots=True)
class WorkFailed:
    """A task that raised, took too long, found its queue full, or whose process died; why, in one line."""

    reason: str


class Workers:
    """Bounded pools by kind of work.

    Attributes:
        slowdown: Factor by which every task is made to last longer, to emulate a slow robot; 1 is full speed.
        stages: How long the stages of tasks took, and how long tasks waited for their turn (KIND_wait).
    """

    def __init__(
        self,
        threads: Mapping[str, int] = THREADS,
        process_kinds: frozenset[str] = PROCESS_KINDS,
        pending_max: int = 256,
        timeout_s: float = 300.0,
        idle_s: float = 60.0,
    ) -> None:
        """Prepare; threads and processes start with their first task.

        Args:
            threads: Threads per kind of work; more run more tasks of the kind at once.
            process_kinds: Kinds that run in a process of their own, one task at a time; functions, arguments and
                results must be picklable, and the function importable.
            pending_max: Tasks of one kind that may wait or run; another one fails at once.
            timeout_s: A task in a process that takes longer is ended.
            idle_s: A process without tasks for so long is ended; its memory is free until the next task.
        """
        self.slowdown = 1.0
        self.stages = StageTimes()
        self._pools = {
            kind: ThreadPoolExecutor(count, thread_name_prefix=kind) for kind, count in sorted(threads.items())
        }
        self._processes = {kind: WorkerProcess(kind, timeout_s, idle_s) for kind in sorted(process_kinds)}
        self._pending = dict.fromkeys([*self._pools, *self._processes], 0)
        self._pending_max = pending_max
        self._is_closed = False

    async def run(self, kind: str, function: Callable[..., T], *arguments: object) -> Ok[T] | WorkFailed:
        """Run a function off the loop; whatever it raises is logged and returned as a failure.

        Args:
            kind: Which workers.
            function: What to run.
            arguments: With what.

        Raises:
            KeyError: There are no workers of this kind.
        """
        if self._is_closed:
            return WorkFailed("the workers are closed")
        if self._pending[kind] >= self._pending_max:
            return WorkFailed(f"{self._pending_max} tasks of kind {kind} are waiting already")
        self._pending[kind] += 1
        began_s = time.monotonic()
        try:
            result = await self._run(kind, function, arguments)
        finally:
            if self.slowdown > 1.0:
                await asyncio.sleep((self.slowdown - 1.0) * (time.monotonic() - began_s))
            self._pending[kind] -= 1
        if isinstance(result, WorkFailed):
            return result
        self._count(kind, result.value, time.monotonic() - began_s)
        return Ok(result.value.value)

    async def _run(
        self, kind: str, function: Callable[..., T], arguments: tuple[object, ...]
    ) -> Ok[Timed[T]] | WorkFailed:
        if kind in self._processes:
            return await self._processes[kind].run(timed, (function, *arguments))
        try:
            pool = self._pools[kind]
            return Ok(await asyncio.get_running_loop().run_in_executor(pool, timed, function, *arguments))
        except Exception as error:
            if self._is_closed:
                return WorkFailed("the workers are closed")
            return _failed(kind, error)

    def _count(self, kind: str, done: Timed[T], whole_s: float) -> None:
        """Note a task's stages, its own time where no stage bears its name, and what was not work as its wait."""
        lasted_s = self.slowdown * done.lasted_s
        for stage, lap_s in {kind: done.lasted_s, **done.laps_s}.items():
            self.stages.observe(stage, self.slowdown * lap_s)
        self.stages.observe(f"{kind}_wait", max(whole_s - lasted_s, 0.0))

    async def close(self) -> None:
        """End all workers: waiting tasks fail, running threads finish, processes are ended. Safe to call twice."""
        self._is_closed = True
        await asyncio.gather(*(process.stop() for process in self._processes.values()))
        for pool in self._pools.values():
            await asyncio.to_thread(pool.shutdown, wait=True, cancel_futures=True)


class WorkerProcess:
    """One process that runs one task at a time; started when needed, again after it died."""

    def __init__(self, kind: str, timeout_s: float, idle_s: float) -> None:
        self._kind = kind
        self._timeout_s = timeout_s
        self._idle_s = idle_s
        self._turn = asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None
        self._idle: asyncio.TimerHandle | None = None
        self._giving_back: asyncio.TimerHandle | None = None
        self._stopping: set[asyncio.Task[None]] = set()
        self._is_closed = False

    @property
    def pid(self) -> int | None:
        """Process identifier, None while there is no process."""
        return self._process.pid if self._process is not None else None

    async def run(self, function: Callable[..., T], arguments: tuple[object, ...]) -> Ok[T] | WorkFailed:
        """Run one task; the process is given up when it dies, takes too long or its caller is cancelled."""
        async with self._turn:
            if self._is_closed:
                return WorkFailed("the workers are closed")
            if self._idle is not None:
                self._idle.cancel()
            try:
                request = [await asyncio.to_thread(pickle.dumps, (function, arguments))]
            except Exception as error:
                return _failed(self._kind, error)
            try:
                async with asyncio.timeout(self._timeout_s):
                    answer = await self._exchange(request.pop())
            except TimeoutError:
                await self._end()
                return self._died(f"took longer than {self._timeout_s:g} s")
            except (asyncio.IncompleteReadError, OSError):
                return self._died(f"its process ended with status {await self._end()}")
            except asyncio.CancelledError:
                await asyncio.shield(self._end())
                raise
            self._idle = asyncio.get_running_loop().call_later(self._idle_s, self._rest)
            if self._giving_back is None:
                self._giving_back = asyncio.get_running_loop().call_later(GIVE_BACK_S, self._give_back)
            return await self._read(answer)

    async def _exchange(self, request: bytes) -> bytes:
        """Send a request, which is let go once it is sent: a task may take long."""
        process = self._process = self._process or await _started()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(LENGTH.pack(len(request)))
        process.stdin.write(request)
        del request
        await process.stdin.drain()
        (length,) = LENGTH.unpack(await process.stdout.readexactly(LENGTH.size))
        return await process.stdout.readexactly(length)

    async def _read(self, answer: bytes) -> Ok[T] | WorkFailed:
        value, failure, trace = await asyncio.to_thread(pickle.loads, answer)
        if failure is None:
            return Ok(value)
        logger.error("a task of kind %s failed: %s\n%s", self._kind, failure, trace)
        return WorkFailed(failure)

    def _died(self, how: str) -> WorkFailed:
        logger.error("a task of kind %s %s", self._kind, how)
        return WorkFailed(how)

    def _give_back(self) -> None:
        """What tasks needed here, on their way there and back, is free by now."""
        self._giving_back = None
        asyncio.get_running_loop().run_in_executor(None, give_back)

    def _rest(self) -> None:
        """Give the memory back; the next task starts a new process."""
        if not self._turn.locked():
            task = asyncio.get_running_loop().create_task(self._end_idle())
            self._stopping.add(task)
            task.add_done_callback(self._stopping.discard)

    async def _end_idle(self) -> None:
        async with self._turn:
            await self._end(gently=True)

    async def stop(self) -> None:
        """End the process for good, also in the middle of a task."""
        self._is_closed = True
        for timer in (self._idle, self._giving_back):
            if timer is not None:
                timer.cancel()
        await self._end(gently=not self._turn.locked())
        await asyncio.gather(*self._stopping)

    async def _end(self, gently: bool = False) -> int | None:
        """End the process, if there is one, and give its exit status."""
        process, self._process = self._process, None
        if process is None:
            return None
        assert process.stdin is not None
        process.stdin.close()
        try:
            async with asyncio.timeout(STOP_TIMEOUT_S if gently else 0.05):
                return await process.wait()
        except TimeoutError:
            process.kill()
            return await process.wait()


async def _started() -> asyncio.subprocess.Process:
    """Start a process that finds the same modules as this one, and never imports this one's main program."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        "from flocc_agent.runtime.workers import serve; serve()",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        env=environment,
    )


def _failed(kind: str, error: Exception) -> WorkFailed:
    logger.error("a task of kind %s failed", kind, exc_info=error)
    return WorkFailed(f"{type(error).__name__}: {error}")


def serve() -> None:
    """Be a worker process: tasks on standard input, results on what was standard output, until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_the_agent()
    os.nice(NICENESS)
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not mix with results
    while True:
        request = _frame(requests)
        if request is None:
            return
        answer = _answer(request)
        try:
            answers.write(LENGTH.pack(len(answer)) + answer)
            answers.flush()
        except BrokenPipeError:
            os._exit(0)
        del request, answer
        give_back()


def _end_with_the_agent() -> None:
    """Where the kernel can, end in the middle of a task when the agent was killed: an optimisation takes minutes."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _frame(requests: BinaryIO) -> bytes | None:
    header = requests.read(LENGTH.size)
    if len(header) < LENGTH.size:
        return None
    (length,) = LENGTH.unpack(header)
    body = requests.read(length)
    return body if len(body) == length else None


def _answer(request: bytes) -> bytes:
    """Run one task and pickle (value, failure, traceback)."""
    answer: tuple[Any, str | None, str]
    try:
        function, arguments = pickle.loads(request)
        return pickle.dumps((function(*arguments), None, ""))
    except Exception as error:
        answer = (None, f"{type(error).__name__}: {error}", traceback.format_exc())
    return pickle.dumps(answer)
