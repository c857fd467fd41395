"""Joins that rest on one place: doubted where what is beside them says otherwise, and asked about; others are not."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.tentative_joins import SECOND_PLACE
from flocc_agent.geometry import pose, pose7, so3_exp
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import ClosureRecord, KeyframeRecord, Record, RejectionRecord, WithdrawalRecord

Float = NDArray[np.float64]
A, B = LogId("alpha"), LogId("bravo")
LENGTH = 30
SEEN = 50
"""Correspondences of an odometry pair: there was much to see."""


class Team:
    """Two robots that walk north, a metre between keyframes, and what their logs say."""

    def __init__(self, turn_rad: float = 0.0) -> None:
        self.graph = GraphAssembly()
        self._numbers = {A: 0, B: 0}
        for log, turned in ((A, 0.0), (B, turn_rad)):
            for k in range(LENGTH):
                T = pose(ahead(turned), ahead(turned)[:, 2] * k)
                self.say(log, KeyframeRecord(k, float(k), pose7(T), None))

    def say(self, log: LogId, record: Record) -> None:
        self.graph.add(NewRecord(log, self._numbers[log], record))
        self._numbers[log] += 1

    def closes(self, i: int, j: int, offset_m: float = 0.0, scale: float | None = 1.0) -> None:
        """By what it sees, bravo's keyframe `j` is half a metre beside alpha's `i`, and some metres ahead."""
        T = pose(np.eye(3), np.array([0.5, 0.0, offset_m]))
        self.say(A, ClosureRecord(KeyframeId(A, i), KeyframeId(B, j), pose7(T), 60, SEEN, 0.9, scale))

    def refuses(self, i: int, j: int, seen: int = SEEN) -> None:
        self.say(A, RejectionRecord(KeyframeId(A, i), KeyframeId(B, j), "few correspondences", 3, seen))

    def doubts(self) -> dict[tuple[int, int], str]:
        closures = self.graph.graph().closures
        return {(c.query.index, c.match.index): c.doubt for c in closures if c.doubt}

    def asked(self) -> list[tuple[int, int]]:
        pairs = self.graph.asked(CandidatePair(KeyframeId(A, 0), KeyframeId(B, 0)))
        return [(pair.low.index, pair.high.index) for pair in pairs]


def ahead(turned_rad: float) -> Float:
    """A camera's rotation that looks along y, or to its left."""
    return np.asarray(so3_exp(np.array([0.0, 0.0, turned_rad])) @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]))


def joined(*closures: tuple[int, int]) -> Team:
    team = Team()
    for i, j in closures:
        team.closes(i, j)
    return team


def test_a_join_of_one_place_asks_for_what_is_beside_it_the_nearest_first() -> None:
    team = joined((14, 10), (15, 11))
    assert [j - i for i, j in team.asked()] == [-4] * 10
    assert all(abs(i - 14) <= abs(later - 14) for (i, _), (later, _) in pairwise(team.asked()))
    assert not team.doubts()


def test_it_is_doubted_where_most_of_what_is_beside_it_is_refused() -> None:
    team = joined((14, 10), (15, 11))
    while asked := team.asked():
        for i, j in asked:
            team.refuses(i, j)
    assert set(team.doubts()) == {(14, 10), (15, 11)}
    assert next(iter(team.doubts().values())).startswith(
        f"{SECOND_PLACE}of 12 places where alpha and bravo would be side by side 10 do not match"
    )


def test_closures_of_a_second_place_lift_the_doubt() -> None:
    team = joined((14, 10), (15, 11))
    for i in (10, 12, 17, 19, 21):
        team.refuses(i, i - 4)
    assert team.doubts()
    team.closes(27, 23)
    assert not team.doubts()
    assert not team.asked()


@pytest.mark.parametrize("seen", [0, 10])
def test_pairs_that_nobody_looked_at_or_with_little_to_see_say_nothing(seen: int) -> None:
    team = joined((14, 10), (15, 11))
    for i in (8, 10, 12, 17, 19, 21):
        team.refuses(i, i - 8, seen)
    assert not team.doubts()


def test_robots_that_meet_once_and_part_have_nothing_to_ask() -> None:
    team = Team(turn_rad=np.pi / 2)  # their cameras look alike where the closure says; then the ways part
    T = pose(ahead(0.0).T @ so3_exp(np.array([0.0, 0.0, -0.6])) @ ahead(0.0), np.array([0.5, 0.0, 0.0]))
    for i in (10, 11):
        team.say(A, ClosureRecord(KeyframeId(A, i), KeyframeId(B, i), pose7(T), 60, SEEN, 0.9, 1.0))
    assert not team.asked()
    assert not team.doubts()


def test_a_place_that_is_seen_twice_is_doubted_and_both_closures_are() -> None:
    team = joined((10, 2))
    team.closes(22, 2, scale=None)
    assert set(team.doubts()) == {(10, 2), (22, 2)}
    assert "bravo/2 was registered with alpha/10, and it or one beside it with alpha/22" in team.doubts()[10, 2]


def test_one_wrong_closure_does_not_turn_a_dozen_into_doubt() -> None:
    team = joined(*((10 + k, 2 + k) for k in range(10)), (10, 3), (11, 4))
    team.closes(29, 2)
    assert set(team.doubts()) == {(29, 2)}


def test_what_was_refused_of_keyframes_that_are_taken_back_does_not_count() -> None:
    team = joined((14, 10), (15, 11))
    for i in (10, 12, 17, 19, 21):
        team.refuses(i, i - 4)
    assert team.doubts()
    team.say(A, WithdrawalRecord(A, 17, 22, False))
    assert not team.doubts()


def test_all_robots_doubt_alike_whatever_comes_first() -> None:
    first = joined((14, 10), (15, 11))
    later = Team()
    for i in (10, 12, 17, 19, 21):
        first.refuses(i, i - 4)
        later.refuses(i, i - 4)
    for i, j in ((15, 11), (14, 10)):
        later.closes(i, j)
    assert first.doubts() == later.doubts() != {}


@pytest.mark.parametrize("seed", range(8))
def test_the_graph_doubts_what_a_look_at_odometry_doubts(seed: int) -> None:
    """The graph's builder passes over logs of which numbers alone say that nothing is doubted."""
    rng = np.random.default_rng(seed)
    team = joined(*{tuple(pair) for pair in rng.integers(0, LENGTH, size=(int(rng.integers(2, 7)), 2)).tolist()})
    for i, j in rng.integers(0, LENGTH, size=(int(rng.integers(0, 60)), 2)).tolist():
        team.refuses(i, j)
        team.refuses(i, max(i - 4, 0))
    told = team.doubts()
    looked = team.graph._tentative.of(A, B).doubted
    assert told == {(pair.low.index, pair.high.index): why for pair, why in looked.items()}
