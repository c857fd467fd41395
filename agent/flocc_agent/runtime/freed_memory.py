"""Give memory that was freed back to the system, where the C library keeps it.

What a round needs for a while (the graph, both ways between the processes, the solution) grows with the mission. glibc
keeps it in the heap of whichever thread it was made in, so that a leader's memory grew by 4 kB for each keyframe of
its team, though nothing held it. Of all heaps but the first it gives back holes alone and never the end, whatever it
is told: a process of our own therefore has one heap for all of its threads.
"""

import ctypes
import functools
import os
import sys
from collections.abc import Callable

ARENA_MAX = -8
"""mallopt(3): how many heaps there may be."""


def have_one_heap() -> None:
    """For a process of our own, before it starts threads; not where its user said how many heaps there are to be."""
    mallopt = _glibc("mallopt")
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if mallopt is not None and "MALLOC_ARENA_MAX" not in os.environ and "malloc.arena_max" not in tunables:
        mallopt(ARENA_MAX, 1)


def give_back() -> None:
    """Give back what is free; takes milliseconds, so not on the event loop. Nothing without glibc."""
    malloc_trim = _glibc("malloc_trim")
    if malloc_trim is not None:
        malloc_trim(0)


@functools.cache
def _glibc(name: str) -> "Callable[..., int] | None":
    """One of its functions, which runs without the interpreter lock."""
    if not sys.platform.startswith("linux"):
        return None
    found: Callable[..., int] | None = getattr(ctypes.CDLL(None), name, None)
    return found
