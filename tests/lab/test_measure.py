"""Figures of docs/reliability.md that hold on virtual time, wherever it runs."""

import pytest

from flocc_lab.measure import gossip, loss


def test_replicating_a_keyframe_costs_at_most_700_bytes_per_neighbour() -> None:
    assert gossip()["bytes_per_keyframe_and_neighbour"] <= 700


@pytest.mark.slow
def test_a_fifth_lost_costs_no_closure_and_six_tenths_as_many_bytes_again_at_most() -> None:
    rows = loss()["loss"]
    assert rows["0.2"]["closures"] == rows["0.0"]["closures"]
    assert rows["0.2"]["bytes_ratio"] <= 1.6
    assert [row["holes"] for row in rows.values()] == [[], [], []]
