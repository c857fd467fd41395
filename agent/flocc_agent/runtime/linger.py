"""Take zenoh's linger off its TCP sockets, so that a robot that drops out does not silence the others.

zenoh (1.10) sets SO_LINGER to 10 s on every TCP and TLS link and has no setting for it. When the lease of a link to a
robot that is gone ends, zenoh closes the socket on its own thread; Linux then holds that thread until what was sent is
acknowledged or 10 s are over, also for sockets that do not block. With one thread for all links (`RUNTIME` in
`zenoh_session`) every other link is silent for that long, once for the control link and again for the bulk link.
Measured: `tests/swarm/test_netns_swarm.py`, the pulled cable.
"""

import contextlib
import os
import socket
import stat
import struct
import sys
import threading
from pathlib import Path

ZENOH_LINGER_S = 10
"""What zenoh sets. Sockets with any other linger are somebody else's, such as the program's around an agent."""
PERIOD_S = 0.5
"""Less than the shortest lease, so that no link can end before its linger is off."""
LINGER = struct.Struct("ii")
OPEN_FILES = Path("/proc/self/fd" if sys.platform.startswith("linux") else "/dev/fd")

OpenSocket = tuple[int, int]
"""The number of an open file, and the inode that tells it from another under the same number later."""

_started = threading.Lock()


def keep_lingers_off() -> None:
    """Start, once per process, the thread that does it; it ends with the process."""
    if OPEN_FILES.is_dir() and _started.acquire(blocking=False):
        threading.Thread(target=_keep_off, name="zenoh-linger", daemon=True).start()


def _keep_off() -> None:
    done: set[OpenSocket] = set()
    pause = threading.Event()
    while not pause.wait(PERIOD_S):
        done = take_lingers_off(done)


def take_lingers_off(done: set[OpenSocket]) -> set[OpenSocket]:
    """Look once through the open sockets of this process.

    Args:
        done: Sockets that were looked at before, as the last call gave them; not looked at again.

    Returns:
        All sockets that are open now.
    """
    seen: set[OpenSocket] = set()
    for number in map(int, os.listdir(OPEN_FILES)):
        with contextlib.suppress(OSError):  # closed meanwhile, or a socket that knows no linger
            status = os.fstat(number)
            if stat.S_ISSOCK(status.st_mode):
                seen.add((number, status.st_ino))
                if (number, status.st_ino) not in done:
                    _take_off(number)
    return seen


def _take_off(number: int) -> None:
    with socket.socket(fileno=os.dup(number)) as same:
        on, linger_s = LINGER.unpack(same.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size))
        if on and linger_s == ZENOH_LINGER_S:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(0, 0))
