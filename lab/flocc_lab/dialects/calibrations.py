"""Draws calibrations in every form, whole ones and ones with a fault, and sees what the reader makes of them.

A whole file must give the camera that was drawn; a file with a fault must be refused. Anything else is wrong, above all
zeros where the file said something.

    python -m flocc_lab.dialects.calibrations --count 500 --seed 1
"""

import argparse
import json
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.lenses import CameraModel, LensKind
from flocc_lab.dialects.calibration_form import Rig, WriterForm
from flocc_lab.dialects.calibration_writers import FORMS
from flocc_launch.datasets.intrinsics import read_lens
from flocc_protocol.errors import FloccError

FAULTY_RATIO = 0.4
RADTAN = (0.3, 0.2, 0.01, 0.01, 0.1, 0.3, 0.2, 0.1, 0.01, 0.01, 0.01, 0.01, 0.02, 0.02)
"""Drawn coefficients are at most so large, in OpenCV's order."""
SIZES = ((640, 480), (752, 480), (1280, 720), (512, 512), (1224, 1024), (160, 120))


@dataclass(frozen=True, slots=True)
class DialectVerdict:
    """What became of one file.

    Attributes:
        form: Name of the form.
        fault: What was wrong with the file, or None.
        outcome: "right", "refused" or "wrong".
        detail: What the reader said, or gave.
    """

    form: str
    fault: str | None
    outcome: str
    detail: str

    @property
    def good(self) -> bool:
        """Whether it is what it has to be."""
        return self.outcome == ("right" if self.fault is None else "refused")


def drawn_rig(form: WriterForm, rng: np.random.Generator) -> Rig:
    """A camera that a form can say."""
    sizes = form.sizes or SIZES
    width, height = sizes[rng.integers(len(sizes))]
    focal = float(np.round(width * rng.uniform(0.5, 1.2), 4))
    fx, fy = focal, float(np.round(focal * rng.uniform(0.98, 1.02), 4))
    cx, cy = (float(np.round(side * rng.uniform(0.45, 0.55), 3)) for side in (width, height))
    kind = form.kinds[rng.integers(len(form.kinds))]
    distortion, shape = _drawn_lens(kind, form, rng)
    model = CameraModel(width, height, fx, fy, cx, cy, distortion, kind, shape)
    T = pose(so3_exp(rng.uniform(-2, 2, 3)), np.round(rng.uniform(-0.5, 0.5, 3), 4))
    shift_s = float(np.round(rng.uniform(-0.05, 0.05), 5)) if form.shift else 0.0
    return Rig(model, T if form.mounting else np.eye(4), shift_s)


def _drawn_lens(
    kind: LensKind, form: WriterForm, rng: np.random.Generator
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    def within(*limits: float) -> tuple[float, ...]:
        signs = rng.choice([-1.0, 1.0], len(limits))
        return tuple(
            float(np.round(s * rng.uniform(0.2, 1.0) * limit, 8)) for s, limit in zip(signs, limits, strict=True)
        )

    match kind:
        case LensKind.PINHOLE:
            return within(*RADTAN[: rng.choice(form.counts)]), ()
        case LensKind.EQUIDISTANT:
            return within(0.05, 0.02, 0.01, 0.005), ()
        case LensKind.FOV:
            return (), (float(np.round(rng.uniform(0.5, 1.0), 6)),)
        case LensKind.OMNIDIRECTIONAL:
            return within(0.2, 0.05, 0.005, 0.005), (float(np.round(rng.uniform(0.8, 2.0), 6)),)
        case LensKind.DOUBLE_SPHERE:
            return (), (float(np.round(rng.uniform(-0.3, 0.3), 6)), float(np.round(rng.uniform(0.5, 0.7), 6)))
        case LensKind.EUCM:
            return (), (float(np.round(rng.uniform(0.4, 0.8), 6)), float(np.round(rng.uniform(0.8, 1.5), 6)))


Fault = Callable[[str], str]


def _with_key(text: str, key: str, value: object) -> str:
    """A file with one more key in the map of its camera; a map in an XML is left as it is."""
    if text.lstrip().startswith("{"):
        table = json.loads(text)
        place = table["value0"]["intrinsics"][0]["intrinsics"] if "value0" in table else _inner(table)
        place[key] = value
        return json.dumps(table)
    if text.startswith("<?xml"):
        added = f"<{key}>{value}</{key}></opencv_storage>" if isinstance(value, float) else "</opencv_storage>"
        return text.replace("</opencv_storage>", added)
    if re.match(r"\[camera\]", text):
        return text + f"{key} = {json.dumps(value)}\n"
    found = re.search(r"^( *)(?:image_width|resolution|width|image_height|camera_model):", text, re.MULTILINE)
    indent = found[1] if found else ""
    at = found.start() if found else len(text)
    return f"{text[:at]}{indent}{key}: {json.dumps(value)}\n{text[at:]}"


def _unknown_key(text: str) -> str:
    """A coefficient under a name that no reader knows."""
    return _with_key(text, "thin_prism_q", 0.01)


def _angles(text: str) -> str:
    """A mounting by angles, which no reader takes."""
    return _with_key(text, "rpy", [-1.57, 0.0, 0.1])


def _place(text: str) -> str:
    """A position under a name that nobody has seen."""
    return _with_key(text, "sits_at", [0.1, -0.05, 0.3])


def _inner(table: dict) -> dict:  # type: ignore[type-arg]
    """The map of a JSON form that describes the camera."""
    if "camera" in table:
        return dict_of(table["camera"])
    if "cameraData" in table or "fisheye_params" in table:
        return table
    first = next(iter(table.values()))
    return dict_of(first) if isinstance(first, dict) and "projection_type" in first else table


def dict_of(value: object) -> dict:  # type: ignore[type-arg]
    """The value, which is a map."""
    assert isinstance(value, dict)
    return value


def _not_finite(text: str) -> str:
    """The focal length is not a number."""
    return re.sub(r"\d+\.\d\d+", "nan", text, count=1)


def _twice(text: str) -> str:
    """The width stands twice with two values."""
    found = re.search(r"^( *)((?:image_|Camera\.)?(?:width|height)): *(\d+)\n", text, re.MULTILINE)
    return (
        text if found is None else text.replace(found[0], f"{found[0]}{found[1]}{found[2]}: {int(found[3]) + 2}\n", 1)
    )


def _short(text: str) -> str:
    """The last distortion coefficient of a list is missing."""
    pattern = r"((?:distortion_coeff\w*|distortion): (?:\[))([^\]]*[1-9][^\]]*), [^,\]]*\]"
    return re.sub(pattern, r"\1\2]", text, count=1)


def _model_contradicts(text: str) -> str:
    """The model is named as one that the coefficients are not of."""
    return re.sub(r"((?:distortion_model|distortion_type): *)[\w-]+", r"\1thin_prism_fisheye", text, count=1)


def _not_rigid(text: str) -> str:
    """The mounting is scaled."""
    found = re.search(r"((?:T_\w+|local_transform|Tbc|IMU\.T_b_c1)\W[^\d-]*)(-?\d[^\]]*)\]", text, re.DOTALL)
    if found is None:
        return text
    numbers = [repr(1.5 * float(number)) for number in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", found[2])]
    return text.replace(found[0], f"{found[1]}{', '.join(numbers)}]", 1) if len(numbers) > 3 else text


def _unknown_mounting(text: str) -> str:
    """VINS' settings that give a mounting and say that nothing is known of it."""
    return text.replace("estimate_extrinsic: 0", "estimate_extrinsic: 2")


def _rectified(text: str) -> str:
    """ORB-SLAM's rectified camera, which has no coefficients, with some."""
    has_coefficients = re.search(r"Camera\d?\.k1: *-?0*\.?0*[1-9]", text) is not None
    return re.sub(r'(Camera\.type: *)"PinHole"', r'\1"Rectified"', text) if has_coefficients else text


FAULTS: dict[str, Fault] = {
    "a key that nobody knows": _unknown_key,
    "a mounting by angles": _angles,
    "a position that nobody knows": _place,
    "a number that is none": _not_finite,
    "a key twice": _twice,
    "a coefficient too few": _short,
    "a model that contradicts": _model_contradicts,
    "a mounting that is no pose": _not_rigid,
    "a mounting that is unknown": _unknown_mounting,
    "a rectified camera with coefficients": _rectified,
}
TEXTS = (
    "ROS INI", "COLMAP", "DSO, TUM monoVO", "DROID-SLAM", "KITTI odometry", "KITTI raw", "ZED", "ZED, distortion apart",
    "ScanNet scene", "BundleFusion",
)  # fmt: skip


def judged(name: str, fault: str | None, rng: np.random.Generator, folder: Path) -> DialectVerdict:
    """Draw one file, read it, and judge what came of it."""
    form = FORMS[name]
    rig = drawn_rig(form, rng)
    text = form.write(rig)
    if fault is not None:
        broken = FAULTS[fault](text)
        fault, text = (None, text) if broken == text else (fault, broken)
    path = folder / form.name
    path.write_text(text, encoding="utf-8")
    try:
        lens = read_lens(path, None if form.sized else (rig.model.width, rig.model.height))
    except FloccError as error:
        return DialectVerdict(name, fault, "refused", str(error))
    same = _is_same(lens.camera, rig.model) and np.allclose(lens.T_body_camera, rig.T_body_camera, atol=1e-6)
    same = same and lens.time_shift_s == rig.time_shift_s
    return DialectVerdict(name, fault, "right" if same else "wrong", f"{lens.camera} of {rig.model}\n{text}")


def _is_same(found: CameraModel, wanted: CameraModel) -> bool:
    if (found.kind, found.width, found.height) != (wanted.kind, wanted.width, wanted.height):
        return False
    first, second = ((m.fx, m.fy, m.cx, m.cy, *m.shape, *(m.distortion or (0.0,) * 4)) for m in (found, wanted))
    return len(first) == len(second) and bool(np.allclose(first, second, rtol=1e-9, atol=1e-9))


def campaign(count: int, seed: int, folder: Path) -> list[DialectVerdict]:
    """Judge so many drawn files, every form in turn."""
    rng = np.random.default_rng(seed)
    names, faults = list(FORMS), list(FAULTS)
    verdicts = []
    for number in range(count):
        name = names[number % len(names)]
        faulty = rng.random() < FAULTY_RATIO and name not in TEXTS
        verdicts.append(judged(name, faults[rng.integers(len(faults))] if faulty else None, rng, folder))
    return verdicts


def main() -> None:
    """Judge drawn files and print what came of them; exit code 1 where one was wrong."""
    parser = argparse.ArgumentParser(description="Calibrations in every form, drawn and read.")
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        verdicts = campaign(options.count, options.seed, Path(folder))
    bad = [verdict for verdict in verdicts if not verdict.good]
    counts = Counter((verdict.fault or "whole", verdict.outcome) for verdict in verdicts)
    lines = [f"{fault}: {count} {outcome}" for (fault, outcome), count in sorted(counts.items())]
    lines += [
        f"WRONG {verdict.form}, {verdict.fault or 'whole'}: {verdict.outcome}: {verdict.detail}" for verdict in bad
    ]
    sys.stdout.write("\n".join([*lines, f"{len(verdicts) - len(bad)} of {len(verdicts)} as they must be", ""]))
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
