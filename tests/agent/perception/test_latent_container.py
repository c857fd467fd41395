import json
import struct
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.perception.latent import MAGIC, BadLatent, pack, unpack

ARRAYS: dict[str, NDArray[Any]] = {
    "a": np.arange(6, dtype=np.float32).reshape(2, 3),
    "b": np.array([1, 2, 3], np.uint8),
}
LATENT = pack("kind/1", {"size": [4, 5]}, ARRAYS)


def test_reads_back_what_was_written() -> None:
    latent = unpack(LATENT, "kind/1")

    assert latent.header == {"size": [4, 5]}
    assert {name: array.dtype for name, array in latent.arrays.items()} == {"a": np.float32, "b": np.uint8}
    np.testing.assert_array_equal(latent.arrays["a"], ARRAYS["a"])
    np.testing.assert_array_equal(latent.arrays["b"], ARRAYS["b"])


def test_refuses_another_kind() -> None:
    with pytest.raises(BadLatent, match=r"kind/1.*not 'kind/2'"):
        unpack(LATENT, "kind/2")


@pytest.mark.parametrize("size", [0, 3, 8, 20, len(LATENT) - 1])
def test_refuses_a_latent_that_is_cut_off(size: int) -> None:
    with pytest.raises(BadLatent):
        unpack(LATENT[:size], "kind/1")


def test_refuses_bytes_behind_the_arrays() -> None:
    with pytest.raises(BadLatent, match="1 bytes more"):
        unpack(LATENT + b"x", "kind/1")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_refuses_values_that_are_not_finite(value: float) -> None:
    with pytest.raises(BadLatent, match="'a' has values that are not finite"):
        unpack(pack("k", {}, {"a": np.array([1.0, value], np.float16)}), "k")


@pytest.mark.parametrize(
    "entry",
    [["a", "|O", [1]], ["a", "<f4", [-1]], ["a", "<f4", [2**40, 2**40]], ["a", "<f4", [True]], ["a"], 7],
)
def test_refuses_an_impossible_array(entry: object) -> None:
    description = json.dumps({"kind": "k", "header": {}, "arrays": [entry]}).encode()

    with pytest.raises(BadLatent):
        unpack(MAGIC + struct.pack("<I", len(description)) + description, "k")


def test_mutated_bytes_are_refused_or_read_but_never_crash() -> None:
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(3000):
        mutated = bytearray(LATENT)
        for place in rng.integers(0, len(LATENT), rng.integers(1, 4)):
            mutated[place] = rng.integers(256)
        try:
            unpack(bytes(mutated), "kind/1")
        except BadLatent:
            refused += 1
    assert refused > 1000


def test_cannot_write_objects() -> None:
    with pytest.raises(ValueError, match="carries"):
        pack("k", {}, {"a": np.array([object()])})
