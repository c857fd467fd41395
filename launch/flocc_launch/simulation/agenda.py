"""Virtual time: what is to happen, in order of time; what was entered first comes first."""

import gc
import heapq
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count

Action = Callable[[], None]


class Agenda:
    """A clock that jumps from one entry to the next."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._entries: list[tuple[float, int, Action]] = []
        self._numbers = count()

    def at(self, time_s: float, action: Action) -> None:
        """Enter an action; one for the past happens now."""
        heapq.heappush(self._entries, (max(time_s, self.now_s), next(self._numbers), action))

    def after(self, pause_s: float, action: Action) -> None:
        """Enter an action for a while from now."""
        self.at(self.now_s + pause_s, action)

    def run_until(self, end_s: float) -> None:
        """Let everything happen that is due by then."""
        with _rare_collections():
            while self._entries and self._entries[0][0] <= end_s:
                self.now_s, _, action = heapq.heappop(self._entries)
                action()
        self.now_s = max(self.now_s, end_s)


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Look for garbage rarely: a swarm keeps millions of small objects and makes hardly any cycles."""
    usual = gc.get_threshold()
    gc.set_threshold(20_000, 50, 1000)
    try:
        yield
    finally:
        gc.set_threshold(*usual)
