"""Describer, Encoder and Registrar of the paper's front end."""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from flocc_agent.config import ConfigError, Mast3rConfig
from flocc_agent.core.interfaces import Image, OdometryPair
from flocc_agent.core.registration import (
    Registration,
    RegistrationFailed,
    RegistrationFailure,
    odometry_scale,
)
from flocc_agent.perception.latent import BadLatent, failed_by
from flocc_agent.perception.mast3r.cosplace import CosPlace
from flocc_agent.perception.mast3r.device import (
    Compute,
    NotEnoughMemory,
    choose_compute,
    is_out_of_memory,
    require_memory,
)
from flocc_agent.perception.mast3r.engine import Engine, LatentOnDevice
from flocc_agent.perception.mast3r.pair import (
    PairResult,
    disagreement_rad,
    estimated_K,
    register_pair,
)
from flocc_agent.perception.mast3r.payload import (
    Payload,
    PixelGeometry,
    jpeg_of,
    read_payload,
    sooner_part,
    write_payload,
)
from flocc_agent.perception.mast3r.preprocess import (
    BadImage,
    PlaceInput,
    mast3r_input,
    place_input,
    plan_crop,
    resized,
    without_distortion,
)
from flocc_agent.perception.mast3r.reciprocal_matching import MatchParameters
from flocc_agent.perception.mast3r.relative_pose import PnpParameters, PoseFailed
from flocc_agent.perception.mast3r.sizes import NAMED_SIZES
from flocc_agent.perception.mast3r.weights import load_cosplace, load_mast3r
from flocc_agent.stages import stage

PLACE_SIDE_MIN_PX = 16
JPEG_QUALITY = 90
"""Of sent images; a lower one is smaller, and its latent less that of the picture."""
ENCODED_IMAGES_MAX = 8
"""Latents of received images kept in memory, 1.5 to 3 MB each."""
CONSISTENCY_ROTATION_RAD = 0.2
"""How far the two decodes' rotations, and directions of translation, may differ."""
ACTIVATION_BYTES = 1_200_000_000
"""What one decode at 512x384 takes above the weights, measured in float32 with attention unfused, rounded up."""


class CosPlaceDescriber:
    """Image to global place descriptor by CosPlace."""

    def __init__(self, network: CosPlace, device: torch.device, kind: PlaceInput = "swarm-slam") -> None:
        self._network = network.to(device).eval()
        self._device = device
        self._kind = kind
        self._lock = threading.Lock()

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return self._network.dimension

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Compute a (D,) float32 descriptor of unit length.

        Raises:
            BadImage: The picture is too small.
            NotEnoughMemory: Memory ran out.
        """
        if min(image.camera.width, image.camera.height) < PLACE_SIDE_MIN_PX:
            size = f"{image.camera.width}x{image.camera.height}"
            raise BadImage(f"image of {size} pixels is smaller than {PLACE_SIDE_MIN_PX} px a side")
        pixels = place_input(without_distortion(image).pixels, self._kind)
        try:
            with self._lock, torch.inference_mode():
                descriptor = self._network(torch.from_numpy(pixels).to(self._device))[0].float().cpu().numpy()
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            raise NotEnoughMemory(f"memory ran out on {self._device} while running CosPlace") from error
        return np.asarray(descriptor, np.float32)


class Mast3rEncoder:
    """Image to latent by MASt3R's encoder, or to a picture that the receiver encodes (`exchange`)."""

    def __init__(self, engine: Engine, model: str, config: Mast3rConfig) -> None:
        self._engine = engine
        self._model = model
        self._config = config

    @property
    def model(self) -> str:
        """Identity of the encoder's weights; latents of one identity can be registered with each other."""
        return self._model

    @property
    def encode_s(self) -> float | None:
        """Smoothed time to encode one picture, seconds; None before the first and unless `exchange` is auto."""
        return self._engine.encode_s if self._config.exchange == "auto" else None

    def encode(self, image: Image) -> bytes:
        """Compute the payload of an image: its latent, its picture, or both, as configured.

        Raises:
            BadImage: The picture is too small, too large or too elongated.
            NotEnoughMemory: Memory ran out.
        """
        return self.encode_batch([image])[0]

    def encode_batch(self, images: Sequence[Image]) -> list[bytes]:
        """Encode several images, those of one size together; see `encode`."""
        framed = [self._framed(image) for image in images]
        jpegs: list[NDArray[np.uint8] | None] = [None] * len(images)
        if self._config.exchange != "latent":
            jpegs = [jpeg_of(pixels, JPEG_QUALITY) for _, pixels in framed]
        latents: list[NDArray[np.float32] | None] = [None] * len(images)
        if self._config.exchange != "image":
            encoded = self._engine.encode([mast3r_input(pixels) for _, pixels in framed])
            latents = [latent[0].float().cpu().numpy() for latent in encoded]
        return [
            write_payload(self._model, geometry, latent, self._config.latent_dtype, jpeg)
            for (geometry, _), latent, jpeg in zip(framed, latents, jpegs, strict=True)
        ]

    def part(self, latent: bytes, encode_bytes: int | None) -> bytes:
        """Cut a stored payload down to the part that reaches the asker's decoder sooner; a single part stays.

        Raises:
            BadLatent: The stored payload is damaged.
        """
        return sooner_part(latent, encode_bytes)

    def _framed(self, image: Image) -> tuple[PixelGeometry, NDArray[np.uint8]]:
        """Undistort, resize and cut an image, and carry its calibration along."""
        image = without_distortion(image)
        crop = plan_crop(image.camera.width, image.camera.height, self._config.image_size_px)
        return PixelGeometry(crop, crop.K(image.camera.K())), resized(image.pixels, crop)


class Mast3rRegistrar:
    """Two latents to matches and a relative pose by MASt3R's decoder, Eq. (1)'s counts and Eq. (6)'s scale."""

    def __init__(self, engine: Engine, model: str, config: Mast3rConfig) -> None:
        self._engine = engine
        self._model = model
        self._config = config
        self._matching = MatchParameters(config.subsample_px)
        self._pnp = PnpParameters()
        self._odometry_pairs: OrderedDict[str, PairResult] = OrderedDict()
        self._encoded: OrderedDict[bytes, LatentOnDevice] = OrderedDict()
        self._lock = threading.Lock()

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's; raises nothing for bad latents or too little memory."""
        if not self._engine.can_decode:
            return RegistrationFailed(RegistrationFailure.NO_MODEL, "this robot holds the encoder only")
        try:
            return self._register(query, match, odometry)
        except BadLatent as error:
            return failed_by(error)
        except (NotEnoughMemory, MemoryError) as error:
            return RegistrationFailed(RegistrationFailure.OUT_OF_MEMORY, str(error))

    def _register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """The paper's registration: loop pair, odometry pair, their counts and the scale."""
        pairs = [(self._read(query), self._read(match))]
        odometry_pair = None if odometry is None else self._known_odometry_pair(odometry.key)
        if odometry is not None and odometry_pair is None:
            pairs.append((self._read(odometry.latent), pairs[0][0]))
        loop_pair, *rest = self._register_pairs(pairs)
        if odometry is not None and rest:
            odometry_pair = self._remember_odometry_pair(odometry.key, rest[0])
        odometry_count = 0 if odometry_pair is None else odometry_pair.matches
        if isinstance(loop_pair.pose, PoseFailed):
            return failed(loop_pair.pose, loop_pair.matches, odometry_count)
        if self._config.consistency_check:
            complaint = self._inconsistency(pairs[0], loop_pair)
            if complaint is not None:
                return failed(complaint, loop_pair.matches, odometry_count)
        return Registration(
            loop_pair.pose.T_1_2_unscaled,
            loop_pair.matches,
            odometry_count,
            scale(odometry, odometry_pair),
            loop_pair.pose.covariance,
            loop_pair.confidence,
            None if odometry_pair is None else odometry_pair.confidence,
        )

    def _read(self, data: bytes) -> tuple[PixelGeometry, LatentOnDevice]:
        """Read a payload, and encode it where it is a picture."""
        payload = read_payload(data, self._model, self._engine.channels)
        size = (payload.geometry.crop.height, payload.geometry.crop.width)
        if payload.latent is not None:
            return payload.geometry, self._engine.place(payload.latent, size)
        return payload.geometry, self._encoded_picture(data, payload, size)

    def _encoded_picture(self, data: bytes, payload: Payload, size: tuple[int, int]) -> LatentOnDevice:
        """Encode a received picture, or take its latent from the last few."""
        assert payload.pixels is not None
        key = hashlib.sha256(data).digest()
        with self._lock:
            known = self._encoded.get(key)
        if known is not None:
            return known
        latent = LatentOnDevice(self._engine.encode([mast3r_input(payload.pixels)])[0], size)
        with self._lock:
            self._encoded[key] = latent
            while len(self._encoded) > ENCODED_IMAGES_MAX:
                self._encoded.popitem(last=False)
        return latent

    def _register_pairs(
        self, pairs: Sequence[tuple[tuple[PixelGeometry, LatentOnDevice], tuple[PixelGeometry, LatentOnDevice]]]
    ) -> list[PairResult]:
        """Decode and register pairs; uncalibrated ones are decoded in both orders for both focal lengths."""
        forward = [(first[1], second[1]) for first, second in pairs]
        backward = [] if self._config.calibrated else [(second, first) for first, second in forward]
        with stage("decode"):
            decoded = self._engine.decode([*forward, *backward])
        results = []
        for k, (first, second) in enumerate(pairs):
            calibrations = (first[0].K, second[0].K) if self._config.calibrated else None
            K_estimated = None if calibrations else estimated_K(decoded[len(pairs) + k][0], second[0])
            results.append(register_pair(decoded[k], calibrations, K_estimated, self._matching, self._pnp))
        return results

    def _inconsistency(
        self,
        pair: tuple[tuple[PixelGeometry, LatentOnDevice], tuple[PixelGeometry, LatentOnDevice]],
        result: PairResult,
    ) -> PoseFailed | None:
        """Compare with the decode in the other order."""
        assert not isinstance(result.pose, PoseFailed)
        (back,) = self._register_pairs([(pair[1], pair[0])])
        if isinstance(back.pose, PoseFailed):
            return PoseFailed(f"the decode in the other order gave no pose: {back.pose.detail}")
        difference = disagreement_rad(result.pose.T_1_2_unscaled, back.pose.T_1_2_unscaled)
        if difference > CONSISTENCY_ROTATION_RAD:
            return PoseFailed(f"the decodes in both orders disagree by {np.degrees(difference):.0f} degrees")
        return None

    def _known_odometry_pair(self, key: str) -> PairResult | None:
        with self._lock:
            return self._odometry_pairs.get(key)

    def _remember_odometry_pair(self, key: str, pair: PairResult) -> PairResult:
        with self._lock:
            self._odometry_pairs[key] = pair
            while len(self._odometry_pairs) > self._config.odometry_pairs_max:
                self._odometry_pairs.popitem(last=False)
        return pair


def failed(pose: PoseFailed, correspondences: int, odometry_correspondences: int) -> RegistrationFailed:
    """A failure with its counts."""
    kind = RegistrationFailure.DEGENERATE if pose.degenerate else RegistrationFailure.NO_MODEL
    if "needed" in pose.detail and not pose.degenerate:
        kind = RegistrationFailure.FEW_CORRESPONDENCES
    return RegistrationFailed(kind, pose.detail, correspondences, odometry_correspondences)


def scale(odometry: OdometryPair | None, pair: PairResult | None) -> float | None:
    """Metres per network unit by Eq. (6), or None where the odometry pair gave none."""
    if odometry is None or pair is None or isinstance(pair.pose, PoseFailed):
        return None
    return odometry_scale(odometry.T_neighbour_query[:3, 3], pair.pose.T_1_2_unscaled[:3, 3])


def build(config: Mast3rConfig) -> tuple[CosPlaceDescriber, Mast3rEncoder, Mast3rRegistrar]:
    """Load both networks and give the three parts that the runtime asks for.

    Raises:
        ConfigError: A path to weights is not set.
        BadCheckpoint: A file is not the network it should be.
        DeviceError: The device asked for is not there.
        NotEnoughMemory: The networks will not fit.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    compute = choose_compute(config.device, config.dtype)
    mast3r_path = given(config.weights, "weights", "MASt3R")
    place_path = given(config.place_weights, "place_weights", "CosPlace")
    check_memory(config, compute, mast3r_path)
    place = load_cosplace(place_path, device=compute.device)
    loaded = load_mast3r(
        mast3r_path, NAMED_SIZES[config.network], with_decoder=not config.encode_only, dtype=compute.dtype
    )
    engine = Engine(loaded.network, compute, config.batch_max, config.compile)
    if config.compile:
        engine.warm_up((384, 512) if config.image_size_px == 512 else (224, 224))
    return (
        CosPlaceDescriber(place.network, compute.device, config.place_input),
        Mast3rEncoder(engine, loaded.model, config),
        Mast3rRegistrar(engine, loaded.model, config),
    )


def given(path: Path | None, key: str, what: str) -> Path:
    """A path from the configuration.

    Raises:
        ConfigError: It is not set.
    """
    if path is None:
        raise ConfigError(f"perception.mast3r.{key} is not set: give the path of a {what} checkpoint (`flocc weights`)")
    return path


def check_memory(config: Mast3rConfig, compute: Compute, path: Path) -> None:
    """Refuse to start where the full network will not fit.

    Raises:
        NotEnoughMemory: With what is needed and what there is.
    """
    if config.network != "full" or not path.is_file():
        return
    share = 303_098_880 if config.encode_only else 688_638_856
    activations = ACTIVATION_BYTES if not config.encode_only else ACTIVATION_BYTES // 4
    needed = share * compute.dtype.itemsize + activations * config.batch_max
    require_memory(needed, compute.device, "MASt3R")
