"""WGS 84: places on Earth, and the local east-north-up frame around one."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, pose

Float = NDArray[np.float64]

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)


class Place(NamedTuple):
    """Latitude and longitude in degrees, height above the ellipsoid in metres."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


def up_at(place: Place) -> Float:
    """Direction (3,) up at a place, in the Earth-centred frame: it knows neither poles nor a date line."""
    phi, lam = np.radians(place.latitude_deg), np.radians(place.longitude_deg)
    return np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])


def direction_of(up: Float) -> tuple[float, float]:
    """Latitude and longitude in degrees of a direction (3,) up, of any length."""
    x, y, z = (float(value) for value in up)
    return float(np.degrees(np.arctan2(z, np.hypot(x, y)))), float(np.degrees(np.arctan2(y, x)))


def T_earth_enu(place: Place) -> Float:
    """Pose (4, 4) of the frame east, north, up at a place in the Earth-centred frame (ECEF)."""
    phi, lam = np.radians(place.latitude_deg), np.radians(place.longitude_deg)
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    up = up_at(place)
    across_m = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY2 * np.sin(phi) ** 2)
    origin = across_m * np.array([up[0], up[1], (1.0 - ECCENTRICITY2) * np.sin(phi)]) + place.altitude_m * up
    return pose(np.column_stack([east, np.cross(up, east), up]), origin)


def place_of(earth_m: Float) -> Place:
    """The place of a point (3,) in the Earth-centred frame, poles and date line included.

    Bowring 1976; exact to 1e-4 m within 1e5 m of the ellipsoid.
    """
    x, y, z = (float(value) for value in earth_m)
    semi_minor_m, out_m = SEMI_MAJOR_M * (1.0 - FLATTENING), float(np.hypot(x, y))
    beta = np.arctan2(z * SEMI_MAJOR_M, out_m * semi_minor_m)
    north = z + ECCENTRICITY2 / (1.0 - ECCENTRICITY2) * semi_minor_m * np.sin(beta) ** 3
    phi = np.arctan2(north, out_m - ECCENTRICITY2 * SEMI_MAJOR_M * np.cos(beta) ** 3)
    surface_m = SEMI_MAJOR_M * np.sqrt(1.0 - ECCENTRICITY2 * np.sin(phi) ** 2)
    altitude_m = out_m * np.cos(phi) + z * np.sin(phi) - surface_m
    return Place(float(np.degrees(phi)), float(np.degrees(np.arctan2(y, x))), float(altitude_m))


def T_enu_enu(origin: Place, place: Place) -> Float:
    """Pose (4, 4) of the frame at a place in the frame at another one, the origin."""
    return np.asarray(inverse(T_earth_enu(origin)) @ T_earth_enu(place))
