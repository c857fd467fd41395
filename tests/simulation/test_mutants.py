"""Cores that are broken on purpose are noticed by the campaign of seeds, each within the first 200.

`make test` runs eight of them, `make campaign` all (`FLOCC_MUTANTS=all`) and prints how many seeds each took.
"""

import os
from collections import Counter

import pytest
from tests.simulation.mutants import MUTANTS, Mutant, first_caught

SEEDS = range(10_000_000, 10_000_200)
QUICK = {
    "T_map_odom is 50 m off",
    "closures are inverted",
    "all closures are rejected",
    "no candidates",
    "rounds only on new closures",
    "the worst-ranked leads",
    "heartbeats ten times as often",
    "pairs are not handed to stronger robots",
    "every correction is believed",
    "what left memory comes back as something else",
}
CHOSEN = [mutant for mutant in MUTANTS if os.environ.get("FLOCC_MUTANTS") == "all" or mutant.name in QUICK]


def test_there_are_forty_mutants_with_names_of_their_own() -> None:
    assert len(MUTANTS) >= 40
    assert max(Counter(mutant.name for mutant in MUTANTS).values()) == 1
    assert len(CHOSEN) >= len(QUICK)


@pytest.mark.parametrize("mutant", CHOSEN, ids=[mutant.name for mutant in CHOSEN])
def test_the_campaign_notices(mutant: Mutant) -> None:
    caught = first_caught(mutant, SEEDS)
    assert caught is not None, f"nobody notices within {len(SEEDS)} seeds: {mutant.name}"
    seed, invariant = caught
    print(f"{seed - SEEDS.start + 1:4d} seeds, {invariant}: {mutant.name}")
