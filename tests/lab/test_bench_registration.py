"""The bench of the paper's front end, at a reduced size: what it measures and that both sides do the same."""

import pytest

pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from flocc_lab.bench.memory import measure
from flocc_lab.bench.registration_ratios import matching_ratios, network_ratios, spread


def test_ratios_of_both_parts_come_with_the_errors_of_bfloat16() -> None:
    ratios, errors = network_ratios("tiny", 1, (32, 48))
    assert sorted(ratios) == ["decode", "decode_cpu", "encode", "encode_cpu"]
    assert all(ratio["min"] <= ratio["median"] <= ratio["max"] for ratio in ratios.values())
    assert all(0 < error < 0.1 for error in errors.values())


@pytest.mark.parametrize("cells", [6, 24])
def test_matching_is_compared_with_a_kd_tree_that_gives_the_same_matches(cells: int) -> None:
    ratios = matching_ratios("matching", cells, 1, (64, 96))
    assert ratios["matching"]["median"] > 0


def test_memory_is_measured_in_a_process_of_its_own() -> None:
    found = measure("tiny", 32, 48, threads=1)
    assert (found["tensors"], found["finite"], found["pts3d"]) == (369, True, [1, 32, 48, 3])
    assert 0.05 < found["rss_peak_gib"] < found["rss_limit_gib"]


def test_a_spread_is_median_minimum_and_maximum() -> None:
    assert spread([3.0, 1.0, 2.0]) == {"median": 2.0, "min": 1.0, "max": 3.0}
