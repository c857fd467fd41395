"""Reciprocal matching: the reference's matches, exactly."""

from functools import cache
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from tests.agent.perception.mast3r_examples import golden  # noqa: E402

from flocc_agent.perception.mast3r.reciprocal_matching import (  # noqa: E402
    MatchParameters,
    match_confidences,
    match_views,
    reciprocal_matches,
    reciprocal_matches_both_ways,
)
from flocc_agent.perception.mast3r.search import BlockIndex, nearest  # noqa: E402


def records() -> tuple[dict[str, Any], list[Any]]:
    everything = golden("match.pt")
    fields = {record["name"]: record for record in everything if record["tag"] == "input"}
    return fields, [record for record in everything if record["tag"] != "input"]


@pytest.mark.golden
def test_matches_equal_the_references_for_every_size_and_subsampling() -> None:
    """The reference searched each in up to three ways; ours is one for all of them."""
    fields, cases = records()
    ours = cache(lambda name, S: reciprocal_matches(fields[name]["A"], fields[name]["B"], S))
    checked = 0
    for case in cases:
        if "S" not in case:
            continue
        found = ours(case["name"], case["S"])
        assert np.array_equal(found.xy1, case["xy1"])
        assert np.array_equal(found.xy2, case["xy2"])
        checked += 1
    assert checked == 24


@pytest.mark.golden
def test_union_of_both_directions_and_its_confidences_equal_the_references() -> None:
    fields, cases = records()
    for case in (case for case in cases if case["tag"] == "nonsym"):
        field = fields[case["name"]]
        found = reciprocal_matches_both_ways(field["A"], field["B"])
        assert np.array_equal(found.xy1, case["xy1"])
        assert np.array_equal(found.xy2, case["xy2"])
        assert np.array_equal(match_confidences(found, field["qa"], field["qb"]), case["conf"].numpy())


DECODED = [("tiny_sq", 4), ("tiny_min", 4), ("tiny_portrait", 4), ("small_land", 8)]


@pytest.mark.golden
@pytest.mark.parametrize(("name", "subsample"), DECODED)
def test_matches_of_decoded_descriptors_equal_the_references(name: str, subsample: int) -> None:
    case = golden(f"{name}.pt")
    desc = [case["out"][f"res{k}"]["desc"][0] for k in (1, 2)]
    found = reciprocal_matches(desc[0], desc[1], subsample)
    for kind in ("dot", "kdtree"):
        assert np.array_equal(found.xy1, case["matches"][kind][0])
        assert np.array_equal(found.xy2, case["matches"][kind][1])


def unit_field(seed: int, height: int, width: int) -> Any:
    values = torch.randn(height, width, 24, generator=torch.Generator().manual_seed(seed))
    return values / values.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("rows", [5, 1024, 1025, 5000])
def test_nearest_equals_a_plain_search_for_any_size(rows: int) -> None:
    queries, database = unit_field(1, 1, 300)[0], unit_field(2, 1, rows)[0]
    assert torch.equal(nearest(queries, database), (queries @ database.T).argmax(dim=1))


@pytest.mark.parametrize("noise", [0.0, 0.05, 1.0])
@pytest.mark.parametrize("size", [(70, 90), (32, 64)])
@pytest.mark.parametrize("fast", [False, True])
def test_the_sieves_never_lose_the_winner(noise: float, size: tuple[int, int], fast: bool) -> None:
    generator = torch.Generator().manual_seed(5)
    field = unit_field(6, *size)
    queries = field.flatten(0, 1)[::3] + noise * torch.randn(len(field.flatten(0, 1)[::3]), 24, generator=generator)
    queries = queries / queries.norm(dim=-1, keepdim=True)
    exact = (queries.double() @ field.flatten(0, 1).double().T).argmax(dim=1)
    assert torch.equal(BlockIndex(field, fast)(queries), exact)


@pytest.mark.parametrize("fast", [False, True])
def test_the_sieves_are_exact_where_scores_are_negative_or_equal(fast: bool) -> None:
    field = unit_field(7, 64, 64).abs()
    field = field / field.norm(dim=-1, keepdim=True)
    queries = -field.flatten(0, 1)[:200]
    exact = (queries.double() @ field.flatten(0, 1).double().T).argmax(dim=1)
    assert torch.equal(BlockIndex(field, fast)(queries), exact)
    flat = torch.ones(64, 64, 24) / 24**0.5
    assert BlockIndex(flat, fast)(flat[0, :5]).tolist() == [0] * 5


def test_nearest_takes_the_first_of_equals() -> None:
    database = torch.ones(3000, 24) / 24**0.5
    assert nearest(database[:7], database).tolist() == [0] * 7


def test_a_field_matches_itself_at_every_seed_but_the_border() -> None:
    field = unit_field(3, 40, 56)
    confidence = torch.ones(40, 56)
    everything = match_views((field, field), (confidence, confidence), MatchParameters(border_px=0))
    assert len(everything) == 5 * 7
    assert np.array_equal(everything.xy1, everything.xy2)
    assert len(match_views((field, field), (confidence, confidence), MatchParameters(border_px=5))) == 3 * 5


def test_low_confidence_pixels_do_not_match() -> None:
    field = unit_field(4, 40, 56)
    low = torch.ones(40, 56)
    low[:, :28] = 0.5
    kept = match_views((field, field), (torch.ones(40, 56), low), MatchParameters(confidence_min=0.9))
    assert len(kept) > 0
    assert kept.xy2[:, 0].min() >= 28


def test_equal_descriptors_everywhere_match_without_error() -> None:
    flat = torch.ones(40, 56, 24) / 24**0.5
    confidence = torch.ones(40, 56)
    assert len(match_views((flat, flat), (confidence, confidence), MatchParameters(border_px=0))) <= 1
