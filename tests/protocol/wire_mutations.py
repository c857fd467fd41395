"""Ways to damage bytes: noise, flipped, cut, doubled and spliced pieces, and hostile values in a message's tree."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import numpy as np

from flocc_protocol.messages import PROTOCOL_VERSION

HOSTILE: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 127, 2**31 - 1, 2**31, 2**32, 2**48, 2**48 + 1, 2**53, 2**63, 2**64 - 1, -(2**63),
    0.0, -0.0, 0.5, 1e7, 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf,
    "", "a", "A", "a~0", "f4", "i1", "f16", "heartbeat", "records", "\x00", "é", "x" * 33, "x" * 70_000,
    b"", b"\x00", bytes(56), b"\xff" * 56, bytes(28), bytes(8193), bytes(70_000),
    [], [[]], [0], [True], [1.0], [2**62, 0], [0] * 257, [0, 7], ["a", 0], [["a", 0], 1], [1, ["a", 0]],
    ["f4", [0, 2**62], b"", 1.0], ["i1", [1], b"\x7f", 1e308], ["f4", [1, 7], bytes(28), 1.0],
    {}, msgpack.ExtType(5, b""), msgpack.ExtType(5, b"x"), msgpack.Timestamp(1, 1),
)  # fmt: skip


def noise(rng: np.random.Generator, _: bytes) -> bytes:
    """Random bytes, half of them behind a valid beginning."""
    data = rng.bytes(int(rng.integers(0, 200)))
    return bytes([0x94, PROTOCOL_VERSION]) + data if rng.random() < 0.5 else data


def flip(rng: np.random.Generator, data: bytes) -> bytes:
    """Change one to four bytes."""
    changed = bytearray(data)
    for position in rng.integers(0, len(data), size=rng.integers(1, 5)):
        changed[position] = rng.integers(0, 256)
    return bytes(changed)


def rearrange(rng: np.random.Generator, data: bytes) -> bytes:
    """Cut a piece out, double it, or put noise or a large header in its place."""
    low, high = sorted(int(k) for k in rng.integers(0, len(data) + 1, size=2))
    headers = (b"\xdd\xff\xff\xff\xff", b"\xdc\xff\xff", b"\xdb\x7f\xff\xff\xff", b"\xc6\x00\x01\x00\x00", b"\x91" * 64)
    middle = (b"", data[low:high] * 2, rng.bytes(4), headers[rng.integers(len(headers))])[rng.integers(4)]
    return data[:low] + middle + data[high:]


def replace_node(rng: np.random.Generator, data: bytes) -> bytes:
    """Put a hostile value in the place of one node of the message's tree, or remove or double a node."""
    root = [msgpack.unpackb(data)]
    nodes = list(_nodes(root))
    parent, k = nodes[rng.integers(len(nodes))]
    match rng.integers(8):
        case 0:
            del parent[k]
        case 1:
            parent.insert(k, parent[k])
        case 2:
            other_parent, other = nodes[rng.integers(len(nodes))]
            parent[k] = other_parent[other] if parent is not other_parent[other] else None
            return bytes(_packed(root))
        case _:
            parent[k] = HOSTILE[rng.integers(len(HOSTILE))]
    return bytes(_packed(root))


def _nodes(parent: list[Any]) -> Iterator[tuple[list[Any], int]]:
    for k, child in enumerate(parent):
        yield parent, k
        if type(child) is list:
            yield from _nodes(child)


def _packed(root: list[Any]) -> bytes:
    try:
        packed: bytes = msgpack.packb(root[0] if root else None)
    except (ValueError, RecursionError):  # a node became its own ancestor
        return b"\x91" * 1000
    return packed


MUTATIONS: tuple[Callable[[np.random.Generator, bytes], bytes], ...] = (
    noise,
    flip,
    rearrange,
    replace_node,
    replace_node,
)
