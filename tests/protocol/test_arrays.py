"""Claims on arrays: what is stored is read back, and what is not an array cannot be built."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.protocol.wire_examples import arrays

from flocc_protocol.arrays import ARRAY_BYTES_MAX, SCALE_MAX, Array


@pytest.mark.parametrize(("dtype", "numpy_dtype"), [("f8", "f8"), ("f4", "f4"), ("f2", "f2")])
@given(seed=st.integers(0, 2**32 - 1), shape=st.lists(st.integers(0, 8), max_size=3))
def test_floats_read_back_as_stored(dtype: str, numpy_dtype: str, seed: int, shape: list[int]) -> None:
    values = np.random.default_rng(seed).normal(size=shape).astype(numpy_dtype)
    np.testing.assert_array_equal(Array.of(values, dtype).numpy(), values.astype(np.float64))


def test_bytes_read_back_as_stored() -> None:
    np.testing.assert_array_equal(Array.of(np.arange(256), "u1").numpy(), np.arange(256.0))


@given(st.integers(0, 2**32 - 1), st.floats(1e-12, 1e12))
def test_int8_loses_at_most_half_a_step(seed: int, magnitude: float) -> None:
    values = np.random.default_rng(seed).normal(size=64) * magnitude
    array = Array.int8(values)
    assert np.max(np.abs(array.numpy() - values)) <= array.scale * 0.5 * (1 + 1e-9)


def test_int8_keeps_zeros() -> None:
    np.testing.assert_array_equal(Array.int8(np.zeros(5)).numpy(), np.zeros(5))


def test_a_descriptor_keeps_its_cosine_in_int8() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 512))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    assert abs(Array.int8(a).numpy() @ Array.int8(b).numpy() - a @ b) < 0.002


@given(arrays())
def test_arrays_are_plain_values(array: Array) -> None:
    twin = Array(array.dtype, array.shape, array.data, array.scale)
    assert twin == array
    assert hash(twin) == hash(array)
    assert np.all(np.isfinite(array.numpy()))


def test_bytes_are_little_endian_whatever_the_input_order() -> None:
    assert Array.of(np.array([1.0], dtype=">f4")).data == b"\x00\x00\x80\x3f"


def test_a_transposed_array_is_stored_in_its_own_order() -> None:
    values = np.arange(6.0).reshape(2, 3).T
    np.testing.assert_array_equal(Array.of(values).numpy(), values)


@pytest.mark.parametrize(
    ("dtype", "shape", "data", "scale"),
    [
        ("f16", (1,), bytes(16), 1.0),
        ("O", (1,), bytes(8), 1.0),
        ("x" * 40_000, (1,), bytes(8), 1.0),
        ("f4", (2,), bytes(4), 1.0),
        ("f4", (-1, -1), bytes(4), 1.0),
        ("u1", (1, 1, 1, 1), bytes(1), 1.0),
        ("f4", (0, 2**60, 2**60), b"", 1.0),
        ("f4", (2**64, 0), b"", 1.0),
        ("u1", (ARRAY_BYTES_MAX + 1,), bytes(ARRAY_BYTES_MAX + 1), 1.0),
        ("i1", (1,), b"\x7f", 0.0),
        ("i1", (1,), b"\x7f", -1.0),
        ("i1", (1,), b"\x7f", float("nan")),
        ("i1", (1,), b"\x7f", float("inf")),
        ("i1", (1,), b"\x7f", 1e308),
        ("i1", (1,), b"\x7f", SCALE_MAX * 2),
        ("f8", (1,), np.float64(1e308).tobytes(), 1e10),
        ("f4", (1,), bytes(4), 2.0),
        ("f4", (1,), np.float32("nan").tobytes(), 1.0),
        ("f2", (1,), np.float16("inf").tobytes(), 1.0),
    ],
)
def test_what_is_not_a_finite_array_within_limits_cannot_be_built(
    dtype: str, shape: tuple[int, ...], data: bytes, scale: float
) -> None:
    with pytest.raises(ValueError, match="array") as caught:
        Array(dtype, shape, data, scale)
    assert len(str(caught.value)) < 120


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_not_stored(value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        Array.of(np.array([1.0, value]))
    with pytest.raises(ValueError, match="finite"):
        Array.int8(np.array([1.0, value]))


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
def test_values_that_a_half_float_cannot_hold_are_not_stored() -> None:
    with pytest.raises(ValueError, match="finite"):
        Array.of(np.array([1e6]), "f2")
