"""The cache of simulated perception gives back what was computed."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import OdometryPair, Perception
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_launch.simulation.eyes import ImageEyes

RESULTS = [
    Registration(np.eye(4), 3, 4, 0.25, 2.0 * np.eye(6), 0.5, 0.75, 1.5),
    Registration(np.eye(4), 3, 4, None),
    RegistrationFailed(RegistrationFailure.NO_MODEL, "why", 5, 6),
]


class Seen:
    """Registers once, and never again."""

    def __init__(self, result: Registration | RegistrationFailed) -> None:
        self.results = [result]

    def register(self, query: bytes, match: bytes, pair: OdometryPair | None) -> Registration | RegistrationFailed:
        return self.results.pop()


@pytest.mark.parametrize("result", RESULTS, ids=["whole", "plain", "failed"])
def test_a_registration_from_the_cache_is_the_one_that_was_computed(
    result: Registration | RegistrationFailed, tmp_path: Path
) -> None:
    perception: Perception = Seen(result)  # type: ignore[assignment]
    eyes = ImageEyes(perception, PerceptionConfig(), tmp_path)
    for _ in range(2):
        found = eyes.register(b"q", b"m", None)
        assert type(found) is type(result)
        for field in fields(result):
            np.testing.assert_array_equal(getattr(found, field.name), getattr(result, field.name))
