"""What became of a pair: an acceptance stands until a robot takes its keyframe back, and again after the next one."""

from functools import reduce

import pytest

from flocc_agent.core.reports import ClosureAccepted, ClosureRejected, ClosureWithdrawn
from flocc_launch.runs.closure_table import WITHDRAWN, Pair, PairFact, updated
from flocc_protocol.ids import KeyframeId

QUERY, MATCH = KeyframeId.parse("r1/3"), KeyframeId.parse("r2/0")
ACCEPTED = ClosureAccepted(
    query=QUERY, match=MATCH, correspondences=32, odometry_correspondences=49, ratio=0.65, by="r1"
)
REJECTED = ClosureRejected(query=QUERY, match=MATCH, reason="few correspondences")
TAKEN_BACK = ClosureWithdrawn(query=QUERY, match=MATCH, again=True)


@pytest.mark.parametrize(
    ("facts", "accepted", "reason"),
    [
        ([ACCEPTED, REJECTED], True, None),
        ([ACCEPTED, TAKEN_BACK], False, WITHDRAWN),
        ([ACCEPTED, TAKEN_BACK, REJECTED], False, "few correspondences"),
        ([ACCEPTED, TAKEN_BACK, ACCEPTED], True, WITHDRAWN),
    ],
)
def test_a_closure_counts_until_it_is_taken_back(facts: list[PairFact], accepted: bool, reason: str | None) -> None:
    pair = reduce(lambda known, fact: updated(known, fact, 1.0), facts, Pair(QUERY, MATCH))
    assert (pair.accepted, pair.reason) == (accepted, reason)
    assert pair.rejected is (not accepted)
