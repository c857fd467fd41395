"""Another feed-forward model as one module that implements Encoder and Registrar; docs/mast3r.md refers to it.

The model here is no network: its latent is a coarse grey picture and it finds the shift between two of them. What
matters is the shape of such a module: an identity, bytes of its own, and no exception for a peer's bad bytes.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera, Encoder, Image, OdometryPair, Registrar
from flocc_agent.core.registration import (
    Registration,
    RegistrationFailed,
    RegistrationFailure,
    odometry_scale,
)
from flocc_agent.geometry import pose
from flocc_agent.perception.latent import BadLatent, pack, unpack

KIND = "shift-net-1"
SIDE = 64
PEAK_MIN = 0.15


class ShiftEncoder:
    """Image to a 64x64 grey picture."""

    model = KIND

    def encode(self, image: Image) -> bytes:
        grey = cv2.resize(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        return pack(KIND, {"focal_px": image.camera.fx * SIDE / image.camera.width}, {"grey": grey})


class ShiftRegistrar:
    """Two grey pictures to a sideways translation, by phase correlation."""

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        try:
            count, t_unscaled = self._shift(query, match)
            neighbour = (0, np.zeros(3)) if odometry is None else self._shift(odometry.latent, query)
        except BadLatent as error:
            return RegistrationFailed(RegistrationFailure.BAD_LATENT, str(error))
        if count < PEAK_MIN * SIDE * SIDE:
            return RegistrationFailed(RegistrationFailure.NO_MODEL, "no clear shift", count, neighbour[0])
        scale = None if odometry is None else odometry_scale(odometry.T_neighbour_query[:3, 3], neighbour[1])
        return Registration(pose(np.eye(3), t_unscaled), count, neighbour[0], scale)

    def _shift(self, first: bytes, second: bytes) -> tuple[int, NDArray[np.float64]]:
        contents = [unpack(data, KIND) for data in (first, second)]
        greys = [content.arrays.get("grey") for content in contents]
        if any(grey is None or grey.shape != (SIDE, SIDE) for grey in greys):
            raise BadLatent(f"the latent holds no picture of {SIDE}x{SIDE}")
        a, b = (np.asarray(grey, np.float64) for grey in greys)
        (dx, dy), peak = cv2.phaseCorrelate(a, b)
        focal = float(contents[0].header["focal_px"])
        return int(max(peak, 0.0) * SIDE * SIDE), np.array([-dx / focal, -dy / focal, 0.0])


def view(shift_px: int) -> Image:
    rng = np.random.default_rng(0)
    scene = cv2.resize(rng.integers(0, 256, (30, 60), dtype=np.uint8), (640, 320), interpolation=cv2.INTER_CUBIC)
    cut = scene[:256, 100 + shift_px : 356 + shift_px]
    pixels = np.asarray(np.repeat(cut[:, :, None], 3, axis=2), np.uint8)
    return Image(pixels, Camera(256, 256, 200.0, 200.0, 128.0, 128.0))


def test_another_model_registers_through_the_same_interface() -> None:
    encoder: Encoder = ShiftEncoder()
    registrar: Registrar = ShiftRegistrar()
    neighbour, query, match = (encoder.encode(view(shift)) for shift in (0, 12, 36))
    T_neighbour_query = pose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    result = registrar.register(query, match, OdometryPair(neighbour, T_neighbour_query, "0-1"))
    assert isinstance(result, Registration)
    assert result.scale_initial is not None
    t_m = result.scale_initial * result.T_query_match_unscaled[:3, 3]
    assert np.allclose(t_m, [0.6, 0.0, 0.0], atol=0.05)


def test_another_model_refuses_foreign_latents_without_an_exception() -> None:
    latent = ShiftEncoder().encode(view(0))
    result = ShiftRegistrar().register(latent, pack("mast3r", {}, {}), None)
    assert isinstance(result, RegistrationFailed)
    assert result.failure is RegistrationFailure.BAD_LATENT
