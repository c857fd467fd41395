"""Every picture is read the same way everywhere, and one that cannot be used is left out and counted."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as PIL

from flocc_agent.core.interfaces import Camera
from flocc_agent.runtime.pictures import (
    FULL,
    Levels,
    PictureError,
    good_pictures,
    levels_of,
    picture_head,
    read_picture,
)
from flocc_agent.runtime.recording import Recording, write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum

WIDTH, HEIGHT = 40, 30
RGB = cv2.resize(np.random.default_rng(1).integers(0, 256, (3, 4, 3)).astype(np.uint8), (WIDTH, HEIGHT))
GREY = np.ascontiguousarray(RGB[..., 0])
ORIENTATION = 274


def pil(pixels: NDArray[Any], form: str, orientation: int | None = None, **options: Any) -> bytes:
    """A file that Pillow writes, which shares no code with the reader."""
    out = io.BytesIO()
    picture = PIL.fromarray(pixels)
    if orientation is not None:
        exif = PIL.Exif()
        exif[ORIENTATION] = orientation
        options["exif"] = exif
    picture.save(out, form, **options)
    return out.getvalue()


LOSSLESS = {
    "png": (pil(RGB, "PNG"), RGB),
    "grey png": (pil(GREY, "PNG"), np.dstack([GREY] * 3)),
    "png with alpha": (pil(np.dstack([RGB, GREY]), "PNG"), RGB),
    "grey png with alpha": (pil(np.dstack([GREY, GREY]), "PNG"), np.dstack([GREY] * 3)),
    "bmp": (pil(RGB, "BMP"), RGB),
    "tiff": (pil(RGB, "TIFF"), RGB),
    "tiff with lzw": (pil(GREY, "TIFF", compression="tiff_lzw"), np.dstack([GREY] * 3)),
    "webp": (pil(RGB, "WEBP", lossless=True), RGB),
    "ppm": (pil(RGB, "PPM"), RGB),
    "pgm": (pil(GREY, "PPM"), np.dstack([GREY] * 3)),
    "png of 16 bits": (pil(GREY.astype(np.uint16) << 8, "PNG"), np.dstack([GREY] * 3)),
    "tiff of 16 bits": (pil(GREY.astype(np.uint16) << 8, "TIFF"), np.dstack([GREY] * 3)),
}


@pytest.mark.parametrize("name", LOSSLESS)
def test_pixels_come_out_as_rgb(name: str) -> None:
    encoded, wanted = LOSSLESS[name]
    np.testing.assert_array_equal(read_picture(encoded, (WIDTH, HEIGHT)), wanted)


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"quality": 95, "subsampling": 0}])
def test_jpeg_is_read(options: dict[str, Any]) -> None:
    found = read_picture(pil(RGB, "JPEG", **options))
    np.testing.assert_allclose(found.astype(int), RGB.astype(int), atol=40)


def test_a_palette_is_looked_up() -> None:
    out = io.BytesIO()
    PIL.fromarray(RGB).quantize(16).save(out, "PNG")
    wanted = np.asarray(PIL.open(io.BytesIO(out.getvalue())).convert("RGB"))
    np.testing.assert_array_equal(read_picture(out.getvalue()), wanted)


@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "WEBP"])
@pytest.mark.parametrize("orientation", [1, 3, 5, 6, 7, 8])
def test_orientation_is_followed_only_to_the_size_of_the_intrinsics(form: str, orientation: int) -> None:
    encoded = pil(RGB, form, orientation, **({"lossless": True} if form == "WEBP" else {"quality": 95}))
    stored = read_picture(encoded, (WIDTH, HEIGHT))
    assert stored.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(stored.astype(int), RGB.astype(int), atol=40)
    if orientation < 5:
        with pytest.raises(PictureError, match="the image is 40x30, but the intrinsics are for 30x40"):
            read_picture(encoded, (HEIGHT, WIDTH))
        return
    turned = {5: PIL.Transpose.TRANSPOSE, 6: PIL.Transpose.ROTATE_270, 7: PIL.Transpose.TRANSVERSE,
              8: PIL.Transpose.ROTATE_90}[orientation]  # fmt: skip
    wanted = np.asarray(PIL.fromarray(stored).transpose(turned))
    np.testing.assert_array_equal(read_picture(encoded, (HEIGHT, WIDTH)), wanted)


@pytest.mark.parametrize("name", [*LOSSLESS, "jpeg"])
def test_a_picture_that_is_cut_off_anywhere_is_refused(name: str) -> None:
    encoded = pil(RGB, "JPEG") if name == "jpeg" else LOSSLESS[name][0]
    for length in (0, 5, len(encoded) // 3, len(encoded) * 9 // 10):
        with pytest.raises(PictureError):
            read_picture(encoded[:length])


def test_bytes_behind_the_end_do_not_matter() -> None:
    assert read_picture(pil(RGB, "JPEG") + bytes(500)).shape == RGB.shape
    assert read_picture(pil(RGB, "PNG") + b"more").shape == RGB.shape


def pages(form: str, count: int) -> bytes:
    out = io.BytesIO()
    first, *rest = (PIL.fromarray(np.roll(RGB, k)) for k in range(count))
    first.save(out, form, save_all=True, append_images=rest)
    return out.getvalue()


@pytest.mark.parametrize(
    ("encoded", "said"),
    [
        (pages("PNG", 2), "is an animated PNG"),
        (pages("WEBP", 2), "is an animated WebP"),
        (pages("TIFF", 3), "is a TIFF of 3 pages"),
        (pages("GIF", 1), "is GIF; flocc reads JPEG"),
        (b"\0\0\0\x18ftypheic\0\0\0\0" + bytes(50), "is HEIC; flocc reads JPEG"),
        (b"\0\0\0\x18ftypavif\0\0\0\0" + bytes(50), "is AVIF"),
        (b"\0\0\0\x18ftypisom\0\0\0\0" + bytes(50), "is a video"),
        (pil(GREY.astype(np.float32), "TIFF"), "is a TIFF of 32-bit numbers that are no pixels"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a git-lfs pointer"),
        (b"<html>404", "is a text file"),
        (b"404 not found", "damaged or of an unknown format"),
    ],
)
def test_other_files_are_refused_by_name(encoded: bytes, said: str) -> None:
    with pytest.raises(PictureError, match=said):
        read_picture(encoded)


def test_one_pair_of_levels_brings_a_sensors_bits_to_eight() -> None:
    grey = np.linspace(0, 239, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(np.uint8)
    for bits in (10, 12, 14, 16):
        deep = (grey.astype(np.uint16) << (bits - 8)).astype(np.uint16)
        assert levels_of([deep]) == Levels(0, 2**bits - 1)
        np.testing.assert_array_equal(levels_of([deep]).eight_bits(deep), grey)


def test_a_thermal_cameras_narrow_range_is_stretched() -> None:
    thermal = (29000 + np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) // 4).astype(np.uint16)
    levels = levels_of([thermal, thermal + 20])
    assert 28800 < levels.black < 29000
    assert 29300 < levels.white < 29500
    assert np.ptp(levels.eight_bits(thermal)) > 130


@pytest.mark.parametrize(("largest", "kind"), [(4095, ">u2"), (1023, ">u2"), (127, "u1")])
def test_white_is_what_a_pnm_says(largest: int, kind: str) -> None:
    values = (GREY.astype(np.float64) * largest / 255).round().astype(kind)
    found = read_picture(b"P5\n%d %d\n%d\n" % (WIDTH, HEIGHT, largest) + values.tobytes())
    np.testing.assert_allclose(found[..., 0].astype(int), GREY.astype(int), atol=2)


def test_black_pictures_stay_black() -> None:
    assert levels_of([np.zeros((4, 4), np.uint16)]) == Levels(0, 255)
    assert levels_of([np.full((4, 4), 300, np.uint16)]) == Levels(0, 1023)


def write_pictures(folder: Path, count: int, suffix: str = ".jpg", pixels: NDArray[Any] = RGB) -> list[Path]:
    folder.mkdir(exist_ok=True)
    files = [folder / f"{k:03d}{suffix}" for k in range(count)]
    for file in files:
        cv2.imwrite(str(file), pixels)
    return files


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])


@pytest.mark.parametrize("place", [0, 7, 15])
def test_one_damaged_picture_is_left_out_wherever_it_stands(tmp_path: Path, place: int) -> None:
    files = write_pictures(tmp_path / "p", 16)
    cut(files[place])
    looked = good_pictures(files, (WIDTH, HEIGHT))
    assert looked.good == tuple(k for k in range(16) if k != place)
    assert looked.fault == f"{files[place]}: the image is cut off: 1 of 16 images was left out"


def test_many_damaged_pictures_are_refused_with_their_number(tmp_path: Path) -> None:
    files = write_pictures(tmp_path / "p", 20)
    for file in files[3:6]:
        cut(file)
    with pytest.raises(PictureError, match=r"003.jpg: the image is cut off \(and 2 others\): 3 of 20 images cannot be"):
        good_pictures(files, None)


def test_pictures_of_another_size_are_found_by_their_heads(tmp_path: Path) -> None:
    files = write_pictures(tmp_path / "p", 12)
    cv2.imwrite(str(files[4]), RGB[:20])
    assert (
        good_pictures(files, None).fault
        == f"{files[4]}: the image is 40x20, but most are 40x30: 1 of 12 images was left out"
    )
    head = picture_head(files[4])
    assert (head.width, head.height, head.format) == (40, 20, "JPEG")


def test_a_recording_plays_without_its_damaged_pictures(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = write_pictures(tmp_path / "images", 12)
    cut(files[0])
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(12.0), np.repeat(np.eye(4)[None], 12, axis=0)))
    write_camera(tmp_path / "camera.toml", Camera(WIDTH, HEIGHT, 30.0, 30.0, 20.0, 15.0), np.eye(4))
    (tmp_path / "images.txt").write_text("".join(f"{k} images/{file.name}\n" for k, file in enumerate(files)))
    recording = Recording.open(tmp_path)
    assert [frame.stamp_s for frame in recording.frames] == [float(k) for k in range(1, 12)]
    assert "1 of 12 images was left out" in caplog.text
    assert recording.levels == FULL
    assert recording.load_image(recording.frames[0]).pixels.shape == (HEIGHT, WIDTH, 3)


def test_a_recording_of_twelve_bits_is_not_black(tmp_path: Path) -> None:
    deep = np.linspace(0, 3824, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(np.uint16)
    files = write_pictures(tmp_path / "images", 4, ".png", deep)
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(4.0), np.repeat(np.eye(4)[None], 4, axis=0)))
    write_camera(tmp_path / "camera.toml", Camera(WIDTH, HEIGHT, 30.0, 30.0, 20.0, 15.0), np.eye(4))
    (tmp_path / "images.txt").write_text("".join(f"{k} images/{file.name}\n" for k, file in enumerate(files)))
    recording = Recording.open(tmp_path)
    pixels = recording.load_image(recording.frames[2]).pixels
    np.testing.assert_array_equal(pixels[..., 0], (deep >> 4).astype(np.uint8))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_tiff_whose_0_is_white_is_shown_as_it_says(kind: type[np.unsignedinteger[Any]]) -> None:
    full = int(np.iinfo(kind).max)
    encoded = pil(full - GREY.astype(kind) * (full // 255), "TIFF", tiffinfo={262: 0})
    np.testing.assert_array_equal(read_picture(encoded)[..., 0], GREY)


def test_a_tiff_of_colours_that_are_not_to_be_shown_as_they_are_is_refused() -> None:
    out = io.BytesIO()
    PIL.new("LAB", (WIDTH, HEIGHT)).save(out, "TIFF")
    with pytest.raises(PictureError, match=r"is a TIFF of CIE L\*a\*b\*, which flocc does not read"):
        read_picture(out.getvalue())
