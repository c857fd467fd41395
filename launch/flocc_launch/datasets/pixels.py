"""Image files on their way into a recording: which can be used, and remapping of what an agent's camera cannot say."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses import CameraModel
from flocc_agent.runtime import pictures
from flocc_agent.runtime.picture_heads import SUFFIXES, head_of
from flocc_agent.runtime.pictures import FULL, Levels, PictureError, good_pictures, picture_head
from flocc_agent.runtime.straightening import Straightener
from flocc_launch.datasets.source import DatasetError, Lens

JPEG_QUALITY = 95
Stamped = tuple[tuple[float, Path], ...]


def read_bytes(file: Path) -> bytes:
    """Contents of a file.

    Raises:
        DatasetError: It cannot be read.
    """
    try:
        return file.read_bytes()
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read: {error.strerror or error}") from error


def decoded(encoded: bytes, where: str) -> NDArray[np.uint8]:
    """Pixels of an encoded image, (H, W, 3) RGB.

    Raises:
        DatasetError: The image is damaged.
    """
    try:
        return pictures.read_picture(encoded)
    except PictureError as error:
        raise DatasetError(f"{where}: {error}") from error


def image_size(file: Path) -> tuple[int, int]:
    """Width and height of an image file, as it is stored.

    Raises:
        DatasetError: It cannot be read.
    """
    try:
        head = picture_head(file)
    except PictureError as error:
        raise DatasetError(f"{file}: {error}") from error
    return head.width, head.height


def usable_images(images: Stamped, size: tuple[int, int] | None) -> tuple[Stamped, tuple[str, ...], Levels]:
    """The images that can be used, a note that counts the others, and levels of those of 16 bits.

    Raises:
        DatasetError: Too many cannot be used.
    """
    try:
        looked = good_pictures([file for _, file in images], size)
    except PictureError as error:
        raise DatasetError(str(error)) from error
    notes = [] if looked.fault is None else [looked.fault]
    if looked.levels != FULL:
        notes.append(levels_note(looked.levels))
    return tuple(images[k] for k in looked.good), tuple(notes), looked.levels


def levels_note(levels: Levels) -> str:
    """What was made of images of 16 bits."""
    return f"images of 16 bits use {levels.black} to {levels.white}, which become 0 to 255"


def agents_camera(lens: Lens) -> Camera:
    """The camera of images that are read as they are.

    Raises:
        DatasetError: They would have to be remapped.
    """
    camera = lens.camera.agent_camera()
    if camera is None:
        raise DatasetError(f"a camera of the {lens.camera.kind} model is read by flocc dataset convert only")
    return camera


class ImageWriter:
    """Brings images to what a recording holds: their own bytes, unless they are remapped or brought to 8 bits.

    Attributes:
        lens: Of the images in the recording.
        straightener: What remaps them.
    """

    def __init__(self, lens: Lens, levels: Levels = FULL) -> None:
        """Prepare.

        Raises:
            DatasetError: The lens does not see as much as is wanted of it.
        """
        self._size = (lens.camera.width, lens.camera.height)
        self._levels = levels
        try:
            self.straightener = Straightener(lens.camera, lens.view_rad)
        except ValueError as error:
            raise DatasetError(str(error)) from error
        self.lens = Lens(CameraModel.of_camera(self.straightener.camera), lens.T_body_camera)

    def written(self, encoded: bytes, suffix: str | None = None) -> tuple[bytes, str]:
        """Bytes and suffix of an image in the recording.

        Args:
            encoded: As it was found.
            suffix: Of its name; None takes that of its format.

        Raises:
            PictureError: It is damaged, or of another size than the intrinsics.
        """
        head = head_of(encoded)
        if (fault := pictures.size_fault(head, self._size)) is not None:
            raise PictureError(fault)
        if not self.straightener.is_needed and head.bits == 8:
            return encoded, suffix or SUFFIXES[head.format]
        pixels = self.straightener.apply(pictures.decoded(encoded, self._size))
        if pixels.dtype == np.uint16:
            pixels = self._levels.eight_bits(pixels)
        return pnm(pixels) if head.bits > 8 and head.format == "PNM" else encoded_image(pixels, head.bits > 8)


def pnm(pixels: NDArray[Any]) -> tuple[bytes, str]:
    """Bytes and suffix of RGB or grey pixels as PNM: lossless, and as fast as copying."""
    height, width = pixels.shape[:2]
    kind, suffix = (b"P6", ".ppm") if pixels.ndim == 3 else (b"P5", ".pgm")
    largest, values = (255, pixels) if pixels.dtype == np.uint8 else (65535, pixels.astype(">u2"))
    return b"%s\n%d %d\n%d\n%s" % (kind, width, height, largest, values.tobytes()), suffix


def encoded_image(pixels: NDArray[Any], lossless: bool) -> tuple[bytes, str]:
    """Bytes and suffix of RGB or grey pixels: PNG, or JPEG of quality 95."""
    import cv2

    bgr: NDArray[Any] = np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    if lossless:
        return cv2.imencode(".png", bgr)[1].tobytes(), ".png"
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes(), ".jpg"


def size_of(images: Sequence[tuple[float, Path]]) -> tuple[int, int]:
    """Size of the first image that can be read.

    Raises:
        DatasetError: None can.
    """
    first: DatasetError | None = None
    for _, file in images:
        try:
            return image_size(file)
        except DatasetError as error:
            first = first or error
    raise DatasetError(f"{images[0][1].parent}: no image in it can be read: {first}")
