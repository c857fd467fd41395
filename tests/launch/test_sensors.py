"""Simulated sensors: places on all of the Earth, and a scenario that names what cannot be drawn."""

import numpy as np
import pytest
from pydantic import ValidationError

from flocc_agent.core.geodesy import Place, T_earth_enu, T_enu_enu, place_of
from flocc_agent.core.measurements import GeodeticFix
from flocc_launch.scenarios.scenario import SensorsScenario
from flocc_launch.scenarios.sensors import place_at


@pytest.mark.parametrize("latitude_deg", [90.0, 89.9999, 0.0, -48.1, -90.0])
@pytest.mark.parametrize("longitude_deg", [180.0, 0.0, -180.0])
def test_a_place_on_earth_has_the_point_it_was_made_of(latitude_deg: float, longitude_deg: float) -> None:
    """By Newton's method on degrees it once left the Earth at the poles and the date line."""
    origin, enu_m = Place(latitude_deg, longitude_deg, 500.0), np.array([8.0, -3.0, 1.5])
    place = place_at(origin, enu_m)
    np.testing.assert_allclose(T_enu_enu(origin, place)[:3, 3], enu_m, atol=1e-6)
    assert GeodeticFix(*place, covariance_m2=np.eye(3)).kind == "gnss", "it is a place that a fix may have"


def test_places_are_found_as_exactly_as_is_said() -> None:
    rng = np.random.default_rng(0)
    for altitude_m in (-1e4, 0.0, 1e5):
        for latitude_deg, longitude_deg in zip(rng.uniform(-90, 90, 50), rng.uniform(-180, 180, 50), strict=True):
            earth_m = T_earth_enu(Place(latitude_deg, longitude_deg, altitude_m))[:3, 3]
            assert np.linalg.norm(T_earth_enu(place_of(earth_m))[:3, 3] - earth_m) < 1e-4


@pytest.mark.parametrize(
    "values",
    [
        {"tags": {"": [1, 2, 3]}},
        {"tags": {"t" * 65: [1, 2, 3]}},
        {"tags": {"7": [1, 2, np.nan]}},
        {"tags": {"7": [1, 2, 1e300]}},
        {"gnss_origin": [95.0, 0.0, 0.0]},
        {"gnss_origin": [0.0, 0.0, np.inf]},
        {"position_sigma_m": 1e-12},
        {"position_sigma_m": 1e20},
        {"translation_sigma_m": np.inf},
        {"rotation_sigma_rad": np.nan},
    ],
)
def test_a_sensor_that_cannot_be_drawn_is_named_by_its_key(values: dict[str, object]) -> None:
    with pytest.raises(ValidationError) as caught:
        SensorsScenario.model_validate(values)
    assert caught.value.errors()[0]["loc"][0] in values
