"""A large map opens quickly, and in little memory."""

import pytest

from flocc_lab.bench.map_size import measure

CPU_MAX_S, MEMORY_MAX_MB = 2.0, 100


@pytest.mark.slow
def test_ten_thousand_keyframes_open_in_two_seconds_and_100_megabytes() -> None:
    found = measure(10_000)
    print(found)
    assert found["keyframes"] == 10_000
    assert found["cpu_s"] <= CPU_MAX_S
    assert found["mb"] <= MEMORY_MAX_MB
