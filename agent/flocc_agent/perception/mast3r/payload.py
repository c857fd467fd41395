"""What travels of a keyframe: the latent, or a JPEG to be encoded by the receiver, or both; with its geometry.

The header says format version, model, data type, size, crop and intrinsics. A payload of another model, or whose
sizes do not fit its header, is refused with `BadLatent`.
"""

from dataclasses import astuple, dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.perception.latent import BadLatent, Latent, OtherFrontEnd, pack, unpack
from flocc_agent.perception.mast3r.preprocess import Crop
from flocc_agent.perception.mast3r.sizes import PATCH_PX

KIND = "mast3r"
VERSION = 1
INT8_MAX = 127
SIDE_MAX_PX = 1024
SOURCE_SIDE_MAX_PX = 65535
JPEG_BYTES_MAX = 8 * 1024 * 1024

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]
LatentDtype = Literal["fp16", "int8"]


@dataclass(frozen=True, slots=True, eq=False)
class PixelGeometry:
    """Where the network's pixels lie in the camera.

    Attributes:
        crop: How the picture became the network's input.
        K: (3, 3) calibration of the network's input, pixels.
    """

    crop: Crop
    K: Float

    def patches(self) -> int:
        """Number of patches, the rows of the latent."""
        return self.crop.height * self.crop.width // PATCH_PX**2


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """A keyframe's payload as read.

    Attributes:
        geometry: Size, crop and calibration.
        latent: (S, C) float32, or None where only the picture was sent.
        pixels: (H, W, 3) uint8 RGB of the network's input, or None where the latent was sent.
    """

    geometry: PixelGeometry
    latent: Float32 | None
    pixels: Pixels | None


def quantised(latent: Float32, dtype: LatentDtype) -> dict[str, NDArray[Any]]:
    """Arrays of a latent (S, C) for the wire.

    int8 scales per channel: trained latents may have channels that dwarf the others, and one scale per token or per
    tensor would then lose the rest.
    """
    if dtype == "fp16":
        top = np.finfo(np.float16).max
        return {"latent": np.clip(latent, -top, top).astype("<f2")}
    scale = np.maximum(np.abs(latent).max(axis=0) / INT8_MAX, np.finfo(np.float32).tiny).astype("<f4")
    return {"latent": np.clip(np.rint(latent / scale), -INT8_MAX, INT8_MAX).astype(np.int8), "scale": scale}


def dequantised(content: Latent) -> Float32:
    """(S, C) float32 of the arrays that `quantised` gave.

    Raises:
        BadLatent: The arrays do not fit together.
    """
    values, scale = content.arrays["latent"], content.arrays.get("scale")
    if values.ndim == 2 and values.dtype == np.float16 and scale is None:
        return values.astype(np.float32)
    per_channel = scale is not None and scale.dtype == np.float32 and scale.shape == values.shape[1:]
    if values.ndim == 2 and values.dtype == np.int8 and per_channel:
        return np.asarray(values * scale, np.float32)
    raise BadLatent(f"the latent's values are {values.dtype} {values.shape} without the scales that belong to them")


def jpeg_of(pixels: Pixels, quality: int) -> NDArray[np.uint8]:
    """Bytes of a JPEG of (H, W, 3) RGB."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(data, np.uint8).reshape(-1)


def pixels_of(jpeg: NDArray[np.uint8], crop: Crop) -> Pixels:
    """(H, W, 3) RGB of a JPEG.

    Raises:
        BadLatent: The bytes are no picture of the size that the header says.
    """
    if jpeg.ndim != 1 or jpeg.dtype != np.uint8 or not 0 < len(jpeg) <= JPEG_BYTES_MAX:
        raise BadLatent("the payload's picture is empty or too large")
    if jpeg_size(jpeg.tobytes()) != (crop.height, crop.width):
        raise BadLatent(f"the payload's picture is no JPEG of {crop.width}x{crop.height} pixels, as its header says")
    try:
        decoded = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    except cv2.error:
        decoded = None
    if decoded is None or decoded.shape != (crop.height, crop.width, 3):
        raise BadLatent("the payload's picture cannot be decoded")
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), np.uint8)


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Height and width in a JPEG's frame header, read before anything is decoded; None if there is none."""
    at = 2 if data[:2] == b"\xff\xd8" else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xC3:
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def write_payload(
    model: str,
    geometry: PixelGeometry,
    latent: Float32 | None,
    dtype: LatentDtype = "fp16",
    jpeg: NDArray[np.uint8] | None = None,
) -> bytes:
    """Serialise a keyframe's latent, its picture, or both.

    Raises:
        ValueError: Neither is given.
    """
    if latent is None and jpeg is None:
        raise ValueError("a payload needs a latent or a picture")
    K = geometry.K
    header = {
        "version": VERSION,
        "model": model,
        "crop": list(astuple(geometry.crop)),
        "K": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        "dtype": dtype,
    }
    arrays: dict[str, NDArray[Any]] = {} if latent is None else quantised(latent, dtype)
    if jpeg is not None:
        arrays["jpeg"] = jpeg
    return pack(KIND, header, arrays)


def read_payload(data: bytes, model: str, channels: int) -> Payload:
    """Read a payload of this model.

    Args:
        data: What a peer sent.
        model: Identity of the weights in use.
        channels: Channels of their latents.

    Raises:
        BadLatent: Damaged, of another version or model, not finite, or with sizes that do not fit the header.
    """
    content = unpack(data, KIND)
    if content.header.get("version") != VERSION:
        raise BadLatent(f"the latent has format version {str(content.header.get('version'))[:16]}, not {VERSION}")
    if content.header.get("model") != model:
        raise OtherFrontEnd(
            f"the latent is of model {str(content.header.get('model'))[:64]!r}, this robot runs {model!r}"
        )
    geometry = PixelGeometry(_crop(content.header.get("crop")), _calibration(content.header.get("K")))
    jpeg = content.arrays.get("jpeg")
    if "latent" in content.arrays:
        latent = dequantised(content)
        if latent.shape != (geometry.patches(), channels):
            expected = f"{geometry.patches()} patches of {channels} channels"
            raise BadLatent(f"the latent is {latent.shape[0]}x{latent.shape[1]}, its header says {expected}")
        if not np.all(np.isfinite(latent)):
            raise BadLatent("the latent has values that are not finite")
        return Payload(geometry, latent, None)
    if jpeg is None:
        raise BadLatent("the payload holds neither a latent nor a picture")
    return Payload(geometry, None, pixels_of(jpeg, geometry.crop))


def _crop(value: object) -> Crop:
    """Check a header's crop."""
    if not isinstance(value, list) or len(value) != 8 or not all(type(number) is int for number in value):
        raise BadLatent("the latent's header lacks its crop")
    crop = Crop(*value)
    inside = 0 <= crop.x0 <= crop.resized_width - crop.width and 0 <= crop.y0 <= crop.resized_height - crop.height
    sides = (crop.width, crop.height)
    fits = all(PATCH_PX <= side <= SIDE_MAX_PX and side % PATCH_PX == 0 for side in sides)
    if not (inside and fits and min(value[:2]) >= 1 and max(value) <= SOURCE_SIDE_MAX_PX):
        raise BadLatent(f"the latent's header has an impossible crop {value}")
    return crop


def _calibration(value: object) -> Float:
    """Check a header's intrinsics."""
    if not isinstance(value, list) or len(value) != 4 or not all(isinstance(number, (int, float)) for number in value):
        raise BadLatent("the latent's header lacks its intrinsics")
    fx, fy, cx, cy = (float(number) for number in value)
    if not (np.all(np.isfinite([fx, fy, cx, cy])) and min(fx, fy) >= 1.0 and max(fx, fy, abs(cx), abs(cy)) <= 1e6):
        raise BadLatent(f"the latent's header has impossible intrinsics {value}")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def sooner_part(data: bytes, encode_bytes: int | None) -> bytes:
    """Cut a stored payload down to what reaches a decoder sooner: the latent, or the picture that is then encoded.

    Args:
        data: A stored payload; one with a single part stays as it is.
        encode_bytes: What the link carries while the receiver encodes a picture: a picture that saves more bytes than
            that is sooner. None where nothing was measured yet, or where no picture is wanted: the latent is sent.

    Raises:
        BadLatent: The stored payload is damaged.
    """
    content = unpack(data, KIND)
    picture = {name: array for name, array in content.arrays.items() if name == "jpeg"}
    latent = {name: array for name, array in content.arrays.items() if name != "jpeg"}
    if not picture or not latent:
        return data
    latent_bytes, picture_bytes = (sum(array.nbytes for array in part.values()) for part in (latent, picture))
    picture_is_sooner = encode_bytes is not None and latent_bytes - picture_bytes > encode_bytes
    return pack(KIND, content.header, picture if picture_is_sooner else latent)
