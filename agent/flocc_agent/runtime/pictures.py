"""The one reader of pictures: files of a recording, of a data set, and compressed messages of bags and live robots.

Pixels come out as (H, W, 3) uint8 RGB. Alpha is left out. A picture is taken as it is stored, which is how the sensor
and its calibration have it; EXIF's orientation is followed only where the calibration is of the turned size. Those of
more than 8 bits are brought to 8 by one pair of levels for a whole recording.
"""

import mmap
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.decoder_noise import quiet_decoders
from flocc_agent.runtime.picture_heads import Encoded, PictureError, PictureHead, head_of, stored_tiff

__all__ = [
    "FULL",
    "PictureHead",
    "Levels",
    "PictureError",
    "good_pictures",
    "levels_of",
    "picture_head",
    "read_picture",
]

Bytes = NDArray[np.uint8]
Pixels = NDArray[Any]
"""uint8 or uint16."""
Size = tuple[int, int]

BITS = (8, 10, 12, 14, 16)
SAMPLE_MAX = 32
VALUES_MAX = 20_000
FLAT_LEVELS = 32
"""Pictures whose values, brought to 8 bits by their largest one, would use fewer levels than this are stretched."""
CONTRAST_MIN = 16
"""Fewer values than this are noise, which is not stretched."""
BAD_RATIO_MAX = 0.1


@dataclass(frozen=True, slots=True)
class Levels:
    """Which 16-bit values become 0 and 255.

    Attributes:
        black: This and smaller ones become 0.
        white: This and larger ones become 255.
    """

    black: int = 0
    white: int = 65535

    def eight_bits(self, pixels: NDArray[np.uint16]) -> Bytes:
        """Bring pixels of any shape to 8 bits; what is outside of the levels is clipped."""
        over = np.clip(pixels, self.black, self.white).astype(np.uint32) - self.black
        return (over * 256 // (self.white + 1 - self.black)).astype(np.uint8)


FULL = Levels()


def levels_of(pictures: Iterable[NDArray[np.uint16]]) -> Levels:
    """One pair of levels for 16-bit pictures of one recording: 0 to the sensor's 10, 12, 14 or 16 bits.

    Values that are so close together that hardly anything would be seen (thermal cameras) are stretched between the
    0.5th and the 99.5th percentile instead, widened by a quarter.
    """
    values, top = [], 0
    for picture in pictures:
        values.append(picture.ravel()[:: max(1, picture.size // VALUES_MAX)])
        top = max(top, int(picture.max()))
    if not values:
        return FULL
    white = next(2**bits - 1 for bits in BITS if top < 2**bits)
    low, high = (int(value) for value in np.percentile(np.concatenate(values), (0.5, 99.5)))
    if high - low < CONTRAST_MIN or (high - low) * 256 >= FLAT_LEVELS * (white + 1):
        return Levels(0, white)
    margin = max((high - low) // 4, 1)
    return Levels(max(low - margin, 0), min(high + margin, 65535))


def picture_head(path: Path) -> PictureHead:
    """Look at a picture file without decoding it.

    Raises:
        PictureError: It cannot be read, is cut off, or of another format.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise PictureError("is not a file")
    try:
        with path.open("rb") as file:
            try:
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
                    return head_of(mapped)
            except ValueError as error:
                if isinstance(error, PictureError):
                    raise
                raise PictureError("the image is empty") from error
    except OSError as error:
        raise PictureError(f"the image cannot be read: {error.strerror or error}") from error


def read_picture(encoded: Encoded, size: Size | None = None, levels: Levels = FULL) -> Bytes:
    """Decode a picture to (H, W, 3) uint8 RGB.

    Args:
        encoded: The file's bytes.
        size: Width and height of the intrinsics; decides about EXIF's orientation. None takes what is stored.
        levels: For pictures of 16 bits.

    Raises:
        PictureError: It is damaged, of another format, of no pixels, or of another size.
    """
    pixels = decoded(encoded, size)
    eight = levels.eight_bits(pixels) if pixels.dtype == np.uint16 else pixels
    return np.ascontiguousarray(eight, dtype=np.uint8)


def decoded(encoded: Encoded, size: Size | None = None) -> Pixels:
    """Decode a picture to (H, W, 3) RGB with its own depth.

    Raises:
        PictureError: See `read_picture`.
    """
    import cv2

    head = head_of(encoded)
    if head.format == "TIFF" and head.orientation != 1:
        encoded = stored_tiff(encoded)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with quiet_decoders():
            bgr = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error:
        bgr = None
    if bgr is None or bgr.shape[:2] != (head.height, head.width):
        raise PictureError(f"the image cannot be read: it is a damaged {head.format}")
    if bgr.dtype not in (np.uint8, np.uint16):
        raise PictureError(f"the image has pixels of {bgr.dtype}; flocc reads 8 and 16 bits")
    bright = _to_full_range(bgr, head)
    bright = np.iinfo(bright.dtype).max - bright if head.is_negative else bright
    return _turned(bright[..., ::-1], head, size)


def _to_full_range(pixels: Pixels, head: PictureHead) -> Pixels:
    """Pixels whose file says that white is less than their type can hold, brought to the whole range."""
    full = int(np.iinfo(pixels.dtype).max)
    if head.largest in (None, full):
        return pixels
    return np.minimum(pixels.astype(np.uint64) * full // head.largest, full).astype(pixels.dtype)


def size_fault(head: PictureHead, size: Size) -> str | None:
    """Why a picture does not fit intrinsics, or None."""
    fits = (head.width, head.height) == size or (head.is_turned and (head.height, head.width) == size)
    return None if fits else f"the image is {head.width}x{head.height}, but the intrinsics are for {size[0]}x{size[1]}"


def _turned(pixels: Pixels, head: PictureHead, size: Size | None) -> Pixels:
    if size is None or (head.width, head.height) == size:
        return pixels
    fault = size_fault(head, size)
    if fault is not None:
        raise PictureError(fault)
    upright = pixels.transpose(1, 0, 2)
    flips = {5: (), 6: (1,), 7: (0, 1), 8: (0,)}[head.orientation]
    return np.ascontiguousarray(np.flip(upright, flips))


@dataclass(frozen=True, slots=True)
class Looked:
    """Which of many picture files can be used.

    Attributes:
        good: Their places in the list.
        fault: What is wrong with the others, one sentence that counts them; None where all are good.
        levels: Of the pictures of 16 bits.
        deep: Whether there are any of more than 8 bits.
    """

    good: tuple[int, ...]
    fault: str | None
    levels: Levels
    deep: bool


def good_pictures(files: Sequence[Path], size: Size | None) -> Looked:
    """Look at every picture file of a recording, without decoding more than a few.

    Args:
        files: At least one.
        size: Of the intrinsics; None takes the most frequent one.

    Raises:
        PictureError: Hardly any, or too many of them, cannot be used; the sentence names the first one.
    """
    heads: list[PictureHead | str] = []
    for file in files:
        try:
            heads.append(picture_head(file))
        except PictureError as error:
            heads.append(str(error))
    usual = _usual_size(heads)
    faults = [head if isinstance(head, str) else size_fault(head, size or usual) for head in heads]
    if size is None:
        faults = [fault and fault.replace("but the intrinsics are for", "but most are") for fault in faults]
    good = tuple(k for k, fault in enumerate(faults) if fault is None)
    bad = len(files) - len(good)
    first = next((f"{file}: {fault}" for file, fault in zip(files, faults, strict=True) if fault), None)
    told = first if bad < 2 else f"{first} (and {bad - 1} others)"
    if bad > max(1, BAD_RATIO_MAX * len(files)) or not good:
        raise PictureError(f"{told}: {bad} of {len(files)} images cannot be used")
    deep = [files[k] for k in good if isinstance(head := heads[k], PictureHead) and head.bits > 8]
    fault = None if told is None else f"{told}: {bad} of {len(files)} images {'was' if bad == 1 else 'were'} left out"
    return Looked(good, fault, _sampled_levels(deep) if deep else FULL, bool(deep))


def _usual_size(heads: list[PictureHead | str]) -> Size:
    sizes = Counter((head.width, head.height) for head in heads if isinstance(head, PictureHead))
    return sizes.most_common(1)[0][0] if sizes else (0, 0)


def _sampled_levels(files: list[Path]) -> Levels:
    chosen = sorted({round(k) for k in np.linspace(0, len(files) - 1, SAMPLE_MAX)})
    return levels_of(_deep_pixels(files[k] for k in chosen))


def _deep_pixels(files: Iterable[Path]) -> Iterator[NDArray[np.uint16]]:
    """Pixels of the files that have 16 bits; what cannot be read is met again when it is wanted."""
    for file in files:
        try:
            pixels = decoded(file.read_bytes())
        except (PictureError, OSError):
            continue
        if pixels.dtype == np.uint16:
            yield np.asarray(pixels, dtype=np.uint16)
