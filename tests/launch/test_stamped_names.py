"""Stamps in the names of images: what cameras and exporters write is read, and what has two readings refused."""

from collections.abc import Callable

import pytest

from flocc_launch.datasets.source import DatasetError
from flocc_launch.datasets.stamped_names import stamps_of_names

ZERO_S = 1_700_000_000  # 2023-11-14 22:13:20 UTC
NS = 10**9

READ: dict[str, tuple[Callable[[int], str], float]] = {
    "seconds and nanoseconds": (lambda k: f"{ZERO_S}_{k * 10**8:09d}", ZERO_S),
    "without leading zeros": (lambda k: f"frame_{ZERO_S}-{k * 10**8}", ZERO_S),
    "seconds and microseconds": (lambda k: f"{ZERO_S}-{k * 10**5:06d}", ZERO_S),
    "decimal seconds": (lambda k: f"{ZERO_S}.{k:01d}00000", ZERO_S),
    "a camera's number behind": (lambda k: f"{ZERO_S}.{k:01d}00000_cam0", ZERO_S),
    "phone": (lambda k: f"PXL_20231114_2213{20000 + 100 * k:05d}", ZERO_S),
    "ISO with dashes": (lambda k: f"2023-11-14T22-13-20.{k}00000", ZERO_S),
    "date with microseconds": (lambda k: f"2023-11-14_22-13-20-{k * 10**5:06d}", ZERO_S),
    "a zone": (lambda k: f"2023-11-15T00:13:20.{k}+02:00", ZERO_S),
    "a zone in the west": (lambda k: f"2023-11-14T20:13:20.{k}-02:00", ZERO_S),
    "some without a point": (lambda k: f"{ZERO_S + 0.1 * k:.1f}".removesuffix(".0"), ZERO_S),
    "milliseconds": (lambda k: f"{ZERO_S * 1000 + 100 * k}", ZERO_S),
    "a counter and microseconds": (lambda k: f"{k:04d}_{ZERO_S * 10**6 + 10**5 * k}", ZERO_S),
    "milliseconds with a point, as RealSense's viewer has": (
        lambda k: f"dump_Color_{ZERO_S * 1000 + 100 * k}.00",
        ZERO_S,
    ),
    "nanoseconds": (lambda k: f"cam0_{ZERO_S * NS + 10**8 * k}", ZERO_S),
    "nanoseconds since a start": (lambda k: f"{5000 * NS + 10**8 * k}", 5000.0),
    "microseconds since a start": (lambda k: f"{5000 * 10**6 + 10**5 * k}", 5000.0),
    "seconds since a start": (lambda k: f"{0.1 * k:.3f}", 0.0),
}


@pytest.mark.parametrize("name", READ)
def test_a_form_is_read(name: str) -> None:
    written, first_s = READ[name]
    stamps_s, _ = stamps_of_names([written(k) for k in range(10)], "images")
    assert stamps_s == pytest.approx([first_s + 0.1 * k for k in range(10)], abs=2e-6)


@pytest.mark.parametrize(
    "written",
    [
        lambda k: f"{k:010d}",
        lambda k: f"frame{k:06d}",
        lambda k: f"DSC_{k:04d}",
        lambda k: f"GOPR0001_{k:05d}",
        lambda k: f"{ZERO_S}_{k:04d}",
        lambda k: "abcdefghij"[k],
    ],
)
def test_numbers_of_images_are_no_stamps(written: Callable[[int], str]) -> None:
    assert stamps_of_names([written(k) for k in range(10)], "images")[0] is None


@pytest.mark.parametrize(
    ("written", "sentence"),
    [
        (
            lambda k: f"{ZERO_S * NS + k * 10**8}_{ZERO_S * NS + k * 10**8 + 5}",
            "hold 2 stamps, 1700000000000000000 and",
        ),
        (
            lambda k: f"{ZERO_S}.{k % 10 * 10**8 + 7}",
            "1 to 9 digits after .* a fraction of a second, or nanoseconds without",
        ),
        (lambda k: f"{ZERO_S + k}_{17 + k * 1013 % 90000}", "can be a fraction of a second or a number of its own"),
        (lambda k: f"20231114_2213{k:02d}_{k:03d}", "can be their fraction or count images"),
        (lambda k: f"20231114_2213{k:02d}_{k}", "can be their fraction or count images"),
        (lambda k: f"20231114_2213{k // 2:02d}" + "_1" * (k % 2), "can be their fraction or count images"),
        (lambda k: f"{ZERO_S + k}.25_{ZERO_S + k}.75", "hold 2 numbers with a point, 1700000000.25 and 1700000000.75"),
        (lambda k: f"{10**10 + 4 * k}", "can be seconds or milliseconds"),
        (lambda k: f"cut_00_{k // 30:02d}_{2 * (k % 30):02d}.500", "can be minutes or count cameras"),
    ],
)
def test_two_readings_are_refused_with_both(written: Callable[[int], str], sentence: str) -> None:
    with pytest.raises(DatasetError, match=f"images: .*{sentence}.*; list the images in images.txt"):
        stamps_of_names([written(k) for k in range(60)], "images")


@pytest.mark.parametrize(
    ("written", "first_s"),
    [
        (lambda k: f"DJI_202311142213{20 + k}_{k + 7:04d}_W", ZERO_S),
        (lambda k: f"Photo 2023-11-14 10.13.{20 + k} PM", ZERO_S),
        (lambda k: f"Photo 2023-11-14 12.13.{20 + k} AM", ZERO_S - 22 * 3600),
    ],
)
def test_dates_with_a_counter_or_half_a_day(written: Callable[[int], str], first_s: float) -> None:
    """A drone's counter was read as 0.0007 s, ten in the evening as ten in the morning."""
    assert stamps_of_names([written(k) for k in range(10)], "images")[0] == [first_s + k for k in range(10)]


@pytest.mark.parametrize("written", [lambda k: "9" * 400 + str(k), lambda k: "9" * 400 + f".{k}"])
def test_a_number_without_an_end_is_no_stamp(written: Callable[[int], str]) -> None:
    assert stamps_of_names([written(k) for k in range(10)], "images")[0] is None


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["1700000000.10_left", "1700000000.12_right", "1700000000.20_left"], r"several cameras \(left, right\)"),
        (
            ["img_CAMERA1_1.25_left", "img_CAMERA1_1.30_right", "img_CAMERA1_1.40_left"],
            r"several cameras \(camera1_left, ",
        ),
        (["1700000000100-cam0", "1700000000120-cam1", "1700000000200-cam0"], r"several cameras \(cam0, cam1\)"),
        (["cam_1_000001", "cam_2_000001", "cam_2_000002"], r"several cameras \(cam_1, cam_2\)"),
        (["221359.900", "221400.150"], "can be seconds, or hours, minutes and seconds"),
    ],
)
def test_names_of_several_cameras_or_of_a_clock_are_refused(names: list[str], said: str) -> None:
    with pytest.raises(DatasetError, match=said):
        stamps_of_names(names, "folder")


def test_a_fraction_behind_an_s_is_read() -> None:
    names = [f"vlcsnap-2023-11-14-22h13m{20 + k}s250" for k in range(3)]
    assert stamps_of_names(names, "folder")[0] == [1_700_000_000.25 + k for k in range(3)]


def test_names_that_hold_one_camera_or_words_like_it_are_read() -> None:
    assert stamps_of_names(["cam1", "cam2", "cam3"], "folder")[0] is None
    for form in ("{}_left", "cam0_{}", "leftover_{}_camera12345"):
        names = [form.format(1_700_000_000_100 + 100 * k) for k in range(3)]
        assert stamps_of_names(names, "folder")[0] == pytest.approx([1_700_000_000.1 + 0.1 * k for k in range(3)])


def test_a_date_that_is_the_same_in_all_names_says_nothing() -> None:
    names = [f"n015-2018-07-24-11-22-45+0800__CAM_FRONT__{1532402927612460 + k * 500000}" for k in range(4)]
    found, how = stamps_of_names(names, "images")
    assert found == pytest.approx([1532402927.61246 + 0.5 * k for k in range(4)])
    assert how == "microseconds"
    counted = [f"IMG_20231114_221320_00_{k:03d}" for k in range(4)]
    assert stamps_of_names(counted, "images")[0] is None


def test_a_screenshots_date_is_read() -> None:
    names = [f"Screenshot 2023-11-14 at 10.13.2{k} PM" for k in range(3)]
    assert stamps_of_names(names, "images")[0] == [1700000000.0, 1700000001.0, 1700000002.0]


def test_colour_and_infrared_in_one_folder_are_two_cameras() -> None:
    names = [f"{1700000000 + 0.5 * k:.2f}_{'rgb' if k % 2 else 'ir'}" for k in range(6)]
    with pytest.raises(DatasetError, match=r"names are of several cameras \(ir, rgb\)"):
        stamps_of_names(names, "images")
