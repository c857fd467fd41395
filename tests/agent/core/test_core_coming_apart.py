"""What counts as coming apart: disagreements beyond what is allowed that last and do not shrink."""

import pytest

from flocc_agent.core.coming_apart import CONTACTS, NEAR_M, SILENT_S, ComingApart, beyond
from flocc_agent.core.own_part import Apart
from flocc_protocol.ids import LogId

A, B = LogId("a"), LogId("b")


def first_apart(*shares: float) -> int | None:
    """At which contact b is found to come apart."""
    watch = ComingApart()
    return next((k for k, share in enumerate(shares) if watch.on_contacts({B: share}, float(k)) == [B]), None)


@pytest.mark.parametrize(
    ("shares", "at"),
    [
        ((2.0,) * CONTACTS, CONTACTS - 1),
        ((2.0, 4.0, 8.0, 16.0, 32.0), CONTACTS - 1),
        ((9.0, 2.0, 9.0, 2.0, 9.0), CONTACTS - 1),
        ((float("nan"),) * CONTACTS, CONTACTS - 1),
        ((32.0, 16.0, 8.0, 4.0, 2.0, 1.5, 1.2), None),
        ((1.0,) * 9, None),
        ((2.0, 2.0, 2.0, 2.0, 0.9, 2.0, 2.0, 2.0, 2.0), None),
        ((100.0, 40.0, 20.0, 10.0, 9.0, 9.0, 9.0, 9.0), 7),
    ],
)
def test_only_what_lasts_and_does_not_shrink_is_coming_apart(shares: tuple[float, ...], at: int | None) -> None:
    assert first_apart(*shares) == at


def test_a_disagreement_holds_until_a_contact_says_else_or_nobody_says_anything() -> None:
    watch = ComingApart()
    watch.on_contacts({A: 0.5, B: 7.0}, 10.0)
    assert watch.until_s() == 10.0 + SILENT_S
    watch.on_contacts({A: 0.5}, 20.0)
    assert watch.until_s() == 10.0 + SILENT_S
    watch.on_contacts({B: 0.5}, 21.0)
    assert watch.until_s() == float("-inf")


def test_robots_are_apart_beyond_covariances_or_beyond_what_odometry_drifts() -> None:
    assert beyond(Apart(m=0.1, strain=3.0), ways_m=100.0) == 3.0
    assert beyond(Apart(m=NEAR_M, strain=0.0), ways_m=0.0) == pytest.approx(1.0)
    assert beyond(Apart(m=60.0, strain=0.0), ways_m=40.0) > 1.0 > beyond(Apart(m=60.0, strain=0.0), ways_m=1000.0)
