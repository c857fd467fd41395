"""Claims on `linger`: zenoh's ten seconds leave its sockets, and nobody else's socket is touched."""

import json
import socket
import subprocess
import sys
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import zenoh
from tests.agent.runtime.loopback import free_ports

from flocc_agent.runtime.linger import LINGER, ZENOH_LINGER_S, take_lingers_off

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith(("linux", "darwin")), reason="needs /proc/self/fd or /dev/fd"
)


def session(**settings: object) -> zenoh.Session:
    config = zenoh.Config()
    values = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        **{k.replace("_", "/"): v for k, v in settings.items()},
    }
    for path, value in values.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def linger_of(one: socket.socket) -> tuple[int, int]:
    on, linger_s = LINGER.unpack(one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size))
    return on, linger_s


def lingering_count() -> int:
    """How many stream sockets of this process linger as zenoh's do; counted without the code under test."""
    count = 0
    for number in range(3, 1024):
        try:
            one = socket.fromfd(number, socket.AF_INET, socket.SOCK_STREAM)
        except OSError:
            continue
        with one:
            try:
                count += linger_of(one) == (1, ZENOH_LINGER_S)
            except OSError:
                continue
    return count


def look_once() -> None:
    """Two linked sessions, counted before and after; in a process whose own thread has not been started."""
    (port,) = free_ports(1)
    address = f"tcp/127.0.0.1:{port}"
    with ExitStack() as stack:
        first = stack.enter_context(closing(session(listen_endpoints=[address])))
        second = stack.enter_context(closing(session(connect_endpoints=[address])))
        assert list(first.info.peers_zid()) == [second.zid()]
        assert lingering_count() == 2, "zenoh sets no linger any more: this module can go"
        seen = take_lingers_off(set())
        assert lingering_count() == 0
        assert take_lingers_off(seen) == seen


def test_zenohs_links_do_not_linger_once_looked_at() -> None:
    """Another test of this process may have started the thread that takes lingers off, so in a process of its own."""
    program = "from tests.agent.runtime.test_linger import look_once; look_once()"
    ended = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parents[3], capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("linger", [(0, 0), (1, 0), (1, 3)])
def test_a_socket_of_the_program_around_keeps_its_linger(linger: tuple[int, int]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as mine:
        mine.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(*linger))
        take_lingers_off(set())
        assert linger_of(mine) == linger
