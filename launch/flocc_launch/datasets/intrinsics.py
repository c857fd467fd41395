"""The one reader of calibrations: whatever tool wrote one, it becomes a lens, or is refused by the name of its form."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flocc_agent.runtime.recording import read_camera
from flocc_agent.runtime.text_tables import RecordingError
from flocc_launch.datasets.calibrations.document import parsed_json, parsed_xml, parsed_yaml, read_text
from flocc_launch.datasets.calibrations.fields import lens_of_keys
from flocc_launch.datasets.calibrations.maps import FORMS, REFUSED_MAPS, Cameras, form_of
from flocc_launch.datasets.calibrations.taken_keys import Keys, plain
from flocc_launch.datasets.calibrations.texts import REFUSED_TEXTS, TEXT_FORMS, text_form
from flocc_launch.datasets.source import DatasetError, Float, Lens

Size = tuple[int, int]
FOLLOWED = (("cam0_calib", "body_T_cam0"), ("relative_config_imucam", None))
"""Keys of VINS-Fusion's and OpenVINS's settings that name the calibration, and where the mounting then is."""


FOCAL_RATIO_MIN, FOCAL_RATIO_MAX = 0.02, 200.0
"""Focal length over the image's side: a lens of 360 degrees has about 0.1, a telescope 50."""
EXCHANGED_OFF_MIN, EXCHANGED_NEAR_MAX = 0.15, 0.06
"""By how much of a side a principal point is off the middle, and off that of images whose sides are exchanged."""
SQUARE_RATIO, EQUAL_RATIO = 0.1, 0.01
MOUNTING_MAX_M = 20.0
"""A camera further from its body was measured in another unit."""
FORM_ERRORS = (
    ValueError, RecordingError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError, RecursionError,
)  # fmt: skip
"""What a file raises that is not of the form it seems."""


def forms_read() -> list[str]:
    """Names of the forms, for sentences and pages."""
    maps, texts = [form.name for form in FORMS[:-1]], [form.name for form in TEXT_FORMS]
    return ["flocc TOML", *maps, *texts, "EuRoC, Kimera, ROS and OpenCV YAML, flat keys"]


def read_lens(path: Path, size: Size | None = None) -> Lens:
    """Read a calibration file; `FILE#NAME` takes one camera of several.

    Args:
        path: The file.
        size: Of the images, for forms that do not say it.

    Raises:
        DatasetError: Unreadable, of no known form, of a camera model that flocc does not read, contradicting itself, or
            with a key that may matter and is not understood.
    """
    path, chosen = _file_and_camera(path)
    if path.suffix == ".toml":
        return believable(Lens(*read_camera(path)), path)
    text = read_text(path)
    try:
        return believable(_lens(path, text, chosen, size), path)
    except FORM_ERRORS as error:
        sentence = (
            str(error) if isinstance(error, ValueError | RecordingError) else f"is not of the form it seems ({error!r})"
        )
        if isinstance(error, RecursionError):
            sentence = "is nested too deeply for a calibration"
        if "intrinsics are missing" in sentence or "is no YAML" in sentence:
            sentence += f"; flocc reads {'; '.join(forms_read())}"
        raise DatasetError(f"{path}: {sentence}") from error


def believable(lens: Lens, path: Path | str) -> Lens:
    """The lens, whose numbers are pixels and metres.

    Raises:
        DatasetError: They are of another unit, or of images of another size.
    """
    camera, t_m = lens.camera, float(np.linalg.norm(lens.T_body_camera[:3, 3]))
    size = f"{camera.width}x{camera.height}"
    if max(camera.cx, camera.cy) <= 1.0 and min(camera.width, camera.height) > 2:
        raise DatasetError(f"{path}: the intrinsics are parts of the image's size {size}; write them in pixels")
    if not (0 <= camera.cx <= camera.width and 0 <= camera.cy <= camera.height):
        raise DatasetError(
            f"{path}: the principal point ({camera.cx:g}, {camera.cy:g}) lies outside of images of {size}; the "
            "intrinsics are of images of another size"
        )
    focals = (camera.fx / camera.width, camera.fy / camera.height)
    if min(focals) < FOCAL_RATIO_MIN or max(focals) > FOCAL_RATIO_MAX:
        raise DatasetError(
            f"{path}: focal lengths of {camera.fx:g} and {camera.fy:g} pixels are none of images of {size}"
        )
    sides, middle = np.array([camera.width, camera.height]), 2 * np.array([camera.cx, camera.cy])
    off, exchanged = (np.abs(middle - each) / sides for each in (sides, sides[::-1]))
    if off.min() > EXCHANGED_OFF_MIN and exchanged.max() < EXCHANGED_NEAR_MAX:
        raise DatasetError(
            f"{path}: the principal point ({camera.cx:g}, {camera.cy:g}) is the middle of images of "
            f"{camera.height}x{camera.width}, not of {size}: width and height, or cx and cy, are exchanged"
        )
    is_square = abs(camera.fx - camera.fy) < SQUARE_RATIO * camera.fx
    if not is_square and abs(camera.fx - camera.cx) < EQUAL_RATIO * camera.fx:
        raise DatasetError(
            f"{path}: {camera.fx:g} {camera.fy:g} {camera.cx:g} {camera.cy:g} would be fx cx fy cy, by their sizes, "
            "where fx fy cx cy is read; write each under its name"
        )
    if t_m > MOUNTING_MAX_M:
        raise DatasetError(f"{path}: the camera is {t_m:g} m from its body; write the mounting in metres")
    return lens


def _file_and_camera(path: Path) -> tuple[Path, str | None]:
    if path.exists() or "#" not in path.name:
        return path, None
    name, _, camera = path.name.rpartition("#")
    return path.with_name(name), camera


def _lens(path: Path, text: str, chosen: str | None, size: Size | None) -> Lens:
    if not text.strip():
        raise ValueError("is empty")
    advice = next((advice for pattern, advice in REFUSED_TEXTS if pattern.search(text)), None)
    if advice is not None:
        raise ValueError(advice)
    if (form := text_form(text)) is not None:
        cameras = form.cameras(text)
    else:
        document = _document(text)
        if (followed := _followed(path, document, size)) is not None:
            return followed
        cameras = _cameras(document, size)
    name, notes = _choice(cameras, chosen, size)
    lens = lens_of_keys(Keys(cameras[name]), size)
    return replace(lens, notes=tuple(f"{path}: {note}" for note in (*notes, *lens.notes)))


def _cameras(document: dict[str, Any], size: Size | None) -> Cameras:
    """Cameras of a document; one that has only a field of view takes the size of the images."""
    if size is not None and isinstance(document.get("frames"), list) and "camera_angle_x" in document:
        document = {"w": size[0], "h": size[1]} | document
    return form_of(document).cameras(document)


def _document(text: str) -> dict[str, Any]:
    start = text.lstrip("\ufeff \t\r\n")[:1]
    value = parsed_json(text) if start == "{" else parsed_xml(text) if start == "<" else parsed_yaml(text)
    if not isinstance(value, dict):
        raise ValueError(f"is no calibration of a known form; flocc reads {'; '.join(forms_read())}")
    refused = next(((name, advice) for name, fits, advice in REFUSED_MAPS if fits(value)), None)
    if refused is not None:
        raise ValueError(f"is {refused[0]}; {refused[1]}")
    return value


def _followed(path: Path, document: dict[str, Any], size: Size | None) -> Lens | None:
    """The lens of the file that settings of VINS-Fusion or OpenVINS name."""
    for key, mounting in FOLLOWED:
        if isinstance(document.get(key), str) and "projection_parameters" not in document:
            lens = read_lens(path.parent / document[key], size)
            given = document.get(mounting) if mounting else None
            note = f"{path}: the camera is of {document[key]}; of the rest, only {mounting or 'that name'} is used"
            if given is None:
                return replace(lens, notes=(*lens.notes, note))
            return replace(lens, T_body_camera=_mounting(given), notes=(*lens.notes, note))
    return None


def _mounting(given: Any) -> Float:
    numbers = {"T_body_camera": given, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "w": 2, "h": 2}
    return lens_of_keys(Keys(numbers), None).T_body_camera


def mounting_of(path: Path) -> Float | None:
    """Where the `sensor.yaml` of any sensor (EuRoC) places it on the body, or None where it does not say.

    Raises:
        DatasetError: Its `T_BS` is no pose.
    """
    try:
        given = _document(read_text(path)).get("T_BS")
        return None if given is None else _mounting(given)
    except FORM_ERRORS as error:
        raise DatasetError(f"{path}: T_BS cannot be read: {error}") from error


def _choice(cameras: Cameras, chosen: str | None, size: Size | None) -> tuple[str, tuple[str, ...]]:
    """The camera to take, and a note on the others.

    Raises:
        ValueError: The wanted one is not there, or several are and none is the first one by its name.
    """
    names = list(cameras)
    if chosen is not None:
        found = next((name for name in names if plain(name) == plain(chosen)), None)
        if found is None:
            raise ValueError(f"has no camera {chosen!r}; it has {', '.join(names)}")
        return found, ()
    if not names:
        raise ValueError("holds no camera")
    if len(names) == 1:
        return names[0], ()
    fitting = [name for name in names if size is not None and cameras[name].get("resolution") == list(size)]
    lefts = [name for name in fitting if name.startswith("LEFT")]
    if len(lefts) == 1:
        return lefts[0], (f"{lefts[0]} was taken, which is of the images' size; FILE#NAME takes another camera",)
    numbered = sorted(name for name in names if plain(name) in ("cam0", "camera0", "camera1", "left"))
    if not numbered or "LEFT" in names:
        raise ValueError(f"holds {len(names)} cameras, name one as FILE#NAME: {', '.join(names[:16])}")
    others = ", ".join(name for name in names if name != numbered[0])
    return numbered[0], (f"{numbered[0]} was taken; FILE#NAME takes another camera ({others})",)
