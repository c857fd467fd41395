"""Image files on their way into a recording: their size, and undistortion of what an agent's camera cannot say."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_launch.datasets.source import DatasetError, Lens

JPEG_QUALITY = 95
MAGIC = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"P5", b"P6", b"BM", b"II*\0", b"MM\0*")


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
    """Pixels of an encoded image, as they are in it.

    Raises:
        DatasetError: The image is damaged.
    """
    import cv2

    pixels = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if encoded else None
    if pixels is None:
        raise DatasetError(f"{where}: the image cannot be read: it is damaged or of an unknown format")
    return np.asarray(pixels, dtype=np.uint8)


def is_image(file: Path) -> bool:
    """Whether a file begins as an image does; one that is cut off further on is not noticed."""
    try:
        with file.open("rb") as opened:
            return opened.read(8).startswith(MAGIC)
    except OSError:
        return False


def image_size(file: Path) -> tuple[int, int]:
    """Width and height of an image file.

    Raises:
        DatasetError: It cannot be read.
    """
    pixels = decoded(read_bytes(file), str(file))
    return int(pixels.shape[1]), int(pixels.shape[0])


def written_lens(lens: Lens) -> Lens:
    """The lens of the images in a recording: without distortion where theirs has a third radial coefficient."""
    if lens.k3 == 0.0:
        return lens
    c = lens.camera
    return Lens(Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy), lens.T_body_camera)


def written_image(file: Path, lens: Lens) -> tuple[bytes, str]:
    """Bytes and suffix of an image in a recording; the file's own, unless it has to be undistorted.

    Raises:
        DatasetError: It cannot be read.
    """
    encoded = read_bytes(file)
    if lens.k3 == 0.0:
        return encoded, file.suffix.lower()
    return undistorted(encoded, str(file), lens)


def undistorted(encoded: bytes, where: str, lens: Lens) -> tuple[bytes, str]:
    """Bytes and suffix of an image without its distortion, as JPEG.

    Raises:
        DatasetError: The image is damaged.
    """
    import cv2

    straight = cv2.undistort(decoded(encoded, where), lens.camera.K(), np.array([*lens.camera.distortion, lens.k3]))
    return cv2.imencode(".jpg", straight, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes(), ".jpg"
