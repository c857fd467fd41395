"""What an encoded picture says of itself before it is decoded: format, size, orientation, depth; whether it is whole.

Works on bytes and on mapped files, of which only the pages that are looked at are read. A picture that cannot be used
is refused with one sentence without the file's name.
"""

import mmap
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass

Encoded = bytes | mmap.mmap

READ = "JPEG, PNG, TIFF, WebP, BMP and PNM"
SUFFIXES = {"JPEG": ".jpg", "PNG": ".png", "TIFF": ".tiff", "WebP": ".webp", "BMP": ".bmp", "PNM": ".pnm"}
REFUSED = (
    (re.compile(rb"....ftyp(heic|heix|hevc|mif1|msf1|heim|heis)", re.DOTALL), "HEIC"),
    (re.compile(rb"....ftyp(avif|avis)", re.DOTALL), "AVIF"),
    (re.compile(rb"....ftyp", re.DOTALL), "a video or another ISO media file"),
    (re.compile(rb"GIF8"), "GIF"),
    (re.compile(rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51"), "JPEG 2000"),
    (re.compile(rb"\xff\x0a|\0\0\0\x0cJXL "), "JPEG XL"),
    (re.compile(rb"\x76\x2f\x31\x01"), "OpenEXR"),
    (re.compile(rb"RIFF....AVI ", re.DOTALL), "an AVI video"),
    (re.compile(rb"II\+\0|MM\0\+"), "BigTIFF"),
    (re.compile(rb"P7\s"), "PAM"),
    (re.compile(rb"#\?RADIANCE|#\?RGBE"), "Radiance HDR"),
    (re.compile(rb"\0\0\x01\0"), "an icon"),
    (re.compile(rb"8BPS"), "a Photoshop file"),
    (re.compile(rb"\x93NUMPY"), "a numpy array"),
    (re.compile(rb"FUJIFILMCCD-RAW|II\x55\0|IIRO|IIRS"), "a camera's raw file"),
    (re.compile(rb"version https://git-lfs"), "a git-lfs pointer (fetch it with git lfs pull)"),
    (re.compile(rb"<\?xml|<svg|<!DOCTYPE|<html"), "a text file"),
)


class PictureError(ValueError):
    """A picture that cannot be used; the sentence does not name it."""


@dataclass(frozen=True, slots=True)
class PictureHead:
    """What is known of a picture before it is decoded.

    Attributes:
        format: One of `SUFFIXES`.
        width: As it is stored.
        height: As it is stored.
        bits: Per channel.
        orientation: EXIF's, 1 (as stored) to 8.
        largest: Value of white where the file says it (PNM), else None.
        is_negative: Whether 0 is white (a TIFF's `WhiteIsZero`), which OpenCV passes over.
    """

    format: str
    width: int
    height: int
    bits: int = 8
    orientation: int = 1
    largest: int | None = None
    is_negative: bool = False

    @property
    def is_turned(self) -> bool:
        """Whether viewers show it with width and height exchanged."""
        return self.orientation >= 5


def head_of(data: Encoded) -> PictureHead:
    """Look at a picture.

    Raises:
        PictureError: It is empty, cut off, of another format, or holds several pictures.
    """
    if len(data) == 0:
        raise PictureError("the image is empty")
    start = bytes(data[:32])
    reader = next((read for magic, read in _READERS if magic.match(start)), None)
    if reader is None:
        name = next((name for magic, name in REFUSED if magic.match(start)), None)
        raise PictureError(
            f"is {name}; flocc reads {READ}"
            if name
            else f"the image is damaged or of an unknown format: {READ} are read"
        )
    try:
        head = reader(data)
    except (struct.error, IndexError) as error:
        raise PictureError("the image is damaged or cut off") from error
    if not (0 < head.width <= 65535 and 0 < head.height <= 65535):
        raise PictureError(f"the image is damaged: its size would be {head.width}x{head.height}")
    return head


def _whole(condition: bool) -> None:
    if not condition:
        raise PictureError("the image is cut off")


def _jpeg(data: Encoded) -> PictureHead:
    at, size, orientation = 2, None, 1
    while True:
        _whole(at + 4 <= len(data))
        if data[at] != 0xFF:
            raise PictureError("the image is damaged")
        marker = data[at + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:
            at += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if marker in _FRAMES:
            size = struct.unpack(">BHHB", data[at + 4 : at + 10])
        elif marker == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            orientation = _exif_orientation(bytes(data[at + 10 : at + 2 + length]))
        elif marker in (0xDA, 0xD9):
            break
        at += 2 + length
    if size is None:
        raise PictureError("the image is damaged")
    _whole(data.rfind(b"\xff\xd9", at) >= 0)
    bits, height, width, channels = size
    if bits != 8:
        raise PictureError(f"is a JPEG of {bits} bits, which flocc does not read; write PNG")
    if channels not in (1, 3, 4):
        raise PictureError(f"is a JPEG of {channels} channels, which flocc does not read")
    return PictureHead("JPEG", width, height, 8, orientation)


_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}


def _png(data: Encoded) -> PictureHead:
    at, orientation, ended = 8, 1, False
    width, height, bits = struct.unpack(">IIB", data[16:25])
    while at + 12 <= len(data) and not ended:
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        if kind == b"acTL" and struct.unpack(">I", data[at + 8 : at + 12])[0] > 1:
            raise PictureError("is an animated PNG: one file must be one image")
        if kind == b"eXIf":
            orientation = _exif_orientation(bytes(data[at + 8 : at + 8 + length]))
        ended = kind == b"IEND"
        at += 12 + length
    _whole(ended)
    return PictureHead("PNG", width, height, max(bits, 8), orientation)


def _webp(data: Encoded) -> PictureHead:
    (length,) = struct.unpack("<I", data[4:8])
    _whole(8 + length <= len(data) + 1)
    at, orientation, size = 12, 1, None
    while at + 8 <= min(len(data), 8 + length):
        kind, count = struct.unpack("<4sI", data[at : at + 8])
        body = at + 8
        if kind == b"VP8X":
            size = tuple(1 + int.from_bytes(data[body + k : body + k + 3], "little") for k in (4, 7))
            if data[body] & 2:
                raise PictureError("is an animated WebP: one file must be one image")
        elif kind == b"VP8 " and size is None:
            size = tuple(side & 0x3FFF for side in struct.unpack("<HH", data[body + 6 : body + 10]))
        elif kind == b"VP8L" and size is None:
            (packed,) = struct.unpack("<I", data[body + 1 : body + 5])
            size = (1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF))
        elif kind == b"EXIF":
            exif = bytes(data[body : body + count])
            orientation = _exif_orientation(exif.removeprefix(b"Exif\0\0"))
        at = body + count + count % 2
    if size is None:
        raise PictureError("the image is damaged")
    return PictureHead("WebP", size[0], size[1], 8, orientation)


def _bmp(data: Encoded) -> PictureHead:
    (length,) = struct.unpack("<I", data[2:6])
    (width, height), (_, _) = struct.unpack("<ii", data[18:26]), struct.unpack("<HH", data[26:30])
    _whole(length <= len(data))
    return PictureHead("BMP", width, abs(height))


def _pnm(data: Encoded) -> PictureHead:
    fields = re.match(
        rb"P([1-7])(?:\s+|#[^\n]*\n)+?(\d+)(?:\s+|#[^\n]*\n)+?(\d+)(?:(?:\s+|#[^\n]*\n)+?(\d+))?\s", data[:4096]
    )
    if fields is None or fields[1] == b"7":
        raise PictureError("is a PNM whose header cannot be read")
    kind, width, height = int(fields[1]), int(fields[2]), int(fields[3])
    largest = int(fields[4] or 1) if kind in (2, 3, 5, 6) else 1
    if kind in (5, 6):
        pixel_bytes = (3 if kind == 6 else 1) * (2 if largest > 255 else 1)
        _whole(len(data) >= fields.end() + width * height * pixel_bytes)
    return PictureHead(
        "PNM", width, height, 16 if largest > 255 else 8, largest=largest if kind not in (1, 4) else None
    )


def _tiff(data: Encoded) -> PictureHead:
    pages = _tiff_pages(data)
    if not pages:
        raise PictureError("the image is damaged")
    whole = [page for page in pages if not page.get(254, (0,))[0] & 1]
    if len(whole) > 1:
        raise PictureError(f"is a TIFF of {len(whole)} pages: one file must be one image")
    page = (whole or pages)[0]
    bits = max(page.get(258, (1,)))
    if page.get(339, (1,))[0] != 1 or bits > 16:
        raise PictureError(
            f"is a TIFF of {bits}-bit numbers that are no pixels (depth or radiance); flocc reads 8 and 16 bits"
        )
    brightness = page.get(262, (1,))[0]
    if brightness in UNREAD_BRIGHTNESS:
        raise PictureError(f"is a TIFF of {UNREAD_BRIGHTNESS[brightness]}, which flocc does not read; write PNG")
    for starts, counts in ((273, 279), (324, 325)):
        parts = zip(page.get(starts, ()), page.get(counts, ()), strict=False)
        _whole(all(start + count <= len(data) for start, count in parts))
    width, height = page.get(256, (0,))[0], page.get(257, (0,))[0]
    return PictureHead("TIFF", width, height, max(bits, 8), _orientation(page), is_negative=brightness == 0)


def stored_tiff(data: Encoded) -> bytes:
    """The same TIFF with orientation 1: OpenCV turns TIFFs even where it is told not to."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack(f"{order}I", data[4:8])
    (count,) = struct.unpack(f"{order}H", data[at : at + 2])
    patched = bytearray(data)
    for place in range(at + 2, at + 2 + 12 * count, 12):
        if struct.unpack(f"{order}H", data[place : place + 2])[0] == _ORIENTATION:
            patched[place + 8 : place + 10] = struct.pack(f"{order}H", 1)
    return bytes(patched)


UNREAD_BRIGHTNESS = {
    4: "a mask",
    8: "CIE L*a*b*",
    9: "ICC L*a*b*",
    32803: "a colour filter's raw pixels",
    34892: "raw pixels",
}
"""What a TIFF's PhotometricInterpretation says of pixels that are none to be shown as they are."""
_ORIENTATION = 274
_TIFF_PAGES_MAX = 64
_TIFF_TYPES = {1: "B", 3: "H", 4: "I"}


def _tiff_pages(data: Encoded) -> list[dict[int, tuple[int, ...]]]:
    """Whole-number fields of each page."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack(f"{order}I", data[4:8])
    pages: list[dict[int, tuple[int, ...]]] = []
    while at and len(pages) < _TIFF_PAGES_MAX:
        (count,) = struct.unpack(f"{order}H", data[at : at + 2])
        fields = (_tiff_field(data, at + 2 + 12 * k, order) for k in range(count))
        pages.append({tag: values for tag, values in fields if values})
        (at,) = struct.unpack(f"{order}I", data[at + 2 + 12 * count : at + 6 + 12 * count])
    return pages


def _tiff_field(data: Encoded, at: int, order: str) -> tuple[int, tuple[int, ...]]:
    tag, kind, count = struct.unpack(f"{order}HHI", data[at : at + 8])
    letter = _TIFF_TYPES.get(kind)
    if letter is None or count > 1 << 20:
        return tag, ()
    length = struct.calcsize(letter) * count
    (pointer,) = struct.unpack(f"{order}I", data[at + 8 : at + 12])
    start = at + 8 if length <= 4 else pointer
    return tag, struct.unpack(f"{order}{count}{letter}", data[start : start + length])


def _exif_orientation(exif: bytes) -> int:
    """Orientation of an EXIF block; one that cannot be read says nothing."""
    try:
        pages = _tiff_pages(exif)
    except (struct.error, IndexError):
        return 1
    return _orientation(pages[0]) if pages else 1


def _orientation(page: dict[int, tuple[int, ...]]) -> int:
    value = page.get(_ORIENTATION, (1,))[0]
    return value if 1 <= value <= 8 else 1


_READERS: tuple[tuple[re.Pattern[bytes], Callable[[Encoded], PictureHead]], ...] = (
    (re.compile(rb"\xff\xd8\xff"), _jpeg),
    (re.compile(rb"\x89PNG\r\n\x1a\n"), _png),
    (re.compile(rb"II\*\0|MM\0\*"), _tiff),
    (re.compile(rb"RIFF....WEBP", re.DOTALL), _webp),
    (re.compile(rb"BM....\0\0\0\0", re.DOTALL), _bmp),
    (re.compile(rb"P[1-6][\s#]"), _pnm),
)
