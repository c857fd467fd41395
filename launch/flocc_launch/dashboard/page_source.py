"""A run folder as a growing state: poll it, get the newest snapshot."""

import json
import threading
import time
from collections.abc import Callable
from datetime import datetime
from typing import Protocol

import numpy as np

from flocc_launch.dashboard.snapshot import Snapshot
from flocc_launch.dashboard.state import SwarmState
from flocc_launch.dashboard.tail import RunTail
from flocc_launch.runs.run_folder import RunFolder, RunFolderError
from flocc_launch.runs.run_records import Run


class SnapshotSource(Protocol):
    """Who knows a swarm's state; asked from the threads of a server."""

    def snapshot_text(self) -> str:
        """The newest state as JSON."""
        ...


class RunSource:
    """Reads what is new in a run folder whenever it is asked; several threads may ask."""

    def __init__(self, folder: RunFolder, clock_s: Callable[[], float] = time.time) -> None:
        """Start at the beginning of the run.

        Args:
            folder: The run folder, of a run that goes on or is over.
            clock_s: Wall clock, Unix seconds.
        """
        self._folder = folder
        self._clock_s = clock_s
        self._tail = RunTail(folder.path)
        self._run = folder.run()
        self._state = SwarmState(self._run.robots, self._run.servers)
        self._over = False
        self._lock = threading.Lock()

    def snapshot(self) -> Snapshot:
        """Read what is new, and give the state of the swarm."""
        with self._lock:
            merged, events = self._tail.poll()
            if merged:
                self._over = True
                self._run = self._folder.run()
                self._state = SwarmState(self._run.robots, self._run.servers)
            for event in events:
                self._state.apply(event)
            if merged:
                self._place()
            return self._state.snapshot(self._now_s(), self._run.scenario)

    def _place(self) -> None:
        """Take the corrected trajectories of a run that is over, of the robots that left one that can be read."""
        for name in self._run.robots:
            try:
                result = self._folder.result(name)
            except RunFolderError:
                continue
            keyframes = [] if result is None else result.keyframes
            self._state.place(name, {k.index: np.array(k.T_map_body[:3]) for k in keyframes if k.T_map_body})

    def snapshot_text(self) -> str:
        """The snapshot as JSON."""
        return json.dumps(self.snapshot().as_json(), allow_nan=False)

    def _now_s(self) -> float | None:
        if self._over:
            return None
        return max(self._state.t, self._clock_s() - started_s(self._run, self._clock_s() - self._state.t))


def started_s(run: Run, fallback_s: float) -> float:
    """Unix time of a run's start; the fallback where it is not known."""
    if isinstance(run.start, str):
        try:
            return datetime.fromisoformat(run.start).timestamp()
        except ValueError:
            return fallback_s
    return fallback_s if run.start is None else run.start
