"""What a leader holds is counted once, and grows with what it knows."""

from itertools import pairwise

from flocc_lab.held import hourly, looked_at


def test_what_a_leader_holds_is_counted_by_structure() -> None:
    rows = list(looked_at(robots=2, minutes=1.0, held=100))
    assert [row["minutes"] for row in rows] == [0.25, 0.5, 0.75, 1.0]
    assert all(before["keyframes"] < after["keyframes"] for before, after in pairwise(rows))
    assert rows[-1]["all_kb"] > rows[0]["all_kb"] > 0
    for row in rows:
        assert sum(row["kb"].values()) <= row["all_kb"]
        assert 0 < row["unbounded_kb"] < row["all_kb"]
        assert list(row["kb"].values()) == sorted(row["kb"].values(), reverse=True)
    rows_kb = rows[-1]["kb"]["recognition._own_rows"]
    assert 0.25 * rows[-1]["keyframes"] * 128 * 4 / 1024 < rows_kb < 200


def test_what_an_hour_costs_is_of_the_second_half() -> None:
    rows = [{"minutes": 30.0 * k, "all_kb": 10 * k * k, "unbounded_kb": 5 * k, "cpu_s": 8.0 + k} for k in range(1, 5)]
    assert hourly(rows) == {"all_kb_per_hour": 120.0, "unbounded_kb_per_hour": 10.0, "cpu_ratio": 1.091}
