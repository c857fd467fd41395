"""Readers of what reconstruction programs write: COLMAP's text model, nerfstudio's transforms.json.

Both give camera poses, taken as ground truth of the camera, and intrinsics. Neither has stamps nor metric scale of its
own: stamps are those that the names say, else one image every `STEP_S`; and that the scale may not be metres is told.
"""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import R_from_q_wxyz, inverse, pose
from flocc_agent.runtime.recording import MASK
from flocc_agent.runtime.text_tables import is_number, numbered_lines, read_text
from flocc_agent.runtime.trajectory import Trajectory, checked_pose
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.colmap_order import SEEN_MAX, contradicted, read_points, seen_in
from flocc_launch.datasets.files import camera_file, camera_files, image_files, listed_file, natural
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import size_of
from flocc_launch.datasets.source import DatasetError, Lens, Source
from flocc_launch.datasets.stamped_names import stamps_of_names

Float = NDArray[np.float64]

STEP_S = 1.0
STEP_MIN_S, STEP_MAX_S = 1e-3, 10.0
"""Between two images of one path; what is further apart or closer is of another unit than seconds."""
REPLICA_RATE_HZ = 30.0
CAMERA_OF_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera looks along -z with y up; ours along z with y down."""

COUNTED = re.compile(r"#\s*Number of images:\s*(\d+)")
FRAME_KEYS = {
    "file_path", "transform_matrix", "timestamp", "colmap_im_id", "depth_file_path", "sharpness",
    "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "camera_angle_x",
}  # fmt: skip
"""What a frame of transforms.json says that is used, or that says nothing of poses, lenses and stamps."""
AXES_KEY = re.compile(r"conven|coord|axes|handed|world_?(to|2)_?cam|w2c|pose_?(type|format)")
AXES_READ = re.compile(
    r"open_?gl|blender|nerf|c2w|cam(era)?_?(to|2)_?world|(w2c|world_?(to|2)_?cam\w*) false|handed\w* right"
)
"""Keys of transforms.json that name a convention of its poses, and what they say of the one that is read."""
COLMAP_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "colmap_text")


def colmap_folder(path: Path) -> Path | None:
    """Where a folder has COLMAP's model: the one of most images, and the first of those; None without any."""
    models = colmap_models(path)
    return max(models, key=_images_in) if len(models) > 1 else next(iter(models), None)


def colmap_models(path: Path) -> list[Path]:
    """Folders with a model of COLMAP, in text or binary form; a reconstruction that fell apart has several."""
    numbered = (place for place in sorted((path / "sparse").glob("*")) if place.name.isdecimal())
    places = dict.fromkeys((*(path / name for name in COLMAP_FOLDERS), *numbered))
    return [place for place in places if _is_text_model(place) or (place / "images.bin").exists()]


def _is_text_model(place: Path) -> bool:
    return (place / "cameras.txt").exists() and (place / "images.txt").exists()


def _images_in(place: Path) -> int:
    """How many images a model has: two lines each in text, the first number of its binary form."""
    if not _is_text_model(place):
        return int.from_bytes((place / "images.bin").read_bytes()[:8], "little")
    return sum(not text.startswith("#") for _, text in numbered_lines(place / "images.txt")) // 2


def read_colmap(path: Path) -> Source:
    """Read COLMAP's text model: `cameras.txt`, `images.txt` (camera from world, w first), and the folder of images.

    Raises:
        DatasetError: It is the binary form, a line is of another form, or no image is there.
    """
    place = colmap_folder(path)
    if place is None or not _is_text_model(place):
        raise DatasetError(
            f"{path}: is a model of COLMAP in its binary form; write it as text: colmap model_converter --input_path "
            "FOLDER --output_path FOLDER --output_type TXT"
        )
    file = place / "images.txt"
    images, seen, cut = _model_images(file)
    used = {image.camera for image in images.values()}
    poses = {
        name: inverse(checked_pose(pose(R_from_q_wxyz(image.q), image.t_m), image.where))
        for name, image in images.items()
    }
    if not poses:
        raise DatasetError(
            f"{place / 'images.txt'}: holds no pose of an image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME)"
        )
    if len(used) > 1:
        raise DatasetError(f"{place / 'images.txt'}: images are of {len(used)} cameras; flocc takes one")
    own = place / f"cameras.txt#{next(iter(used))}"
    lens = read_lens(own)
    _refuse_other_order(place, images, seen, lens)
    source = _source(path, "colmap", _image_folder(path), poses, lens)
    transforms = [path / "transforms.json"] if (path / "transforms.json").exists() else []
    return replace(
        source,
        notes=(*source.notes, *_cut_rows(file, cut, len(poses)), *_other_models(path, place)),
        calibrations=(own, *(each for each in camera_files(path) if each != place / "cameras.txt"), *transforms),
    )


def _other_models(path: Path, place: Path) -> list[str]:
    """What is to be said of models that are not taken: their poses are of other frames and scales."""
    others = [str(other.relative_to(path)) for other in colmap_models(path) if other != place]
    told = f"{path}: the model {place.relative_to(path)} was taken; not those of other frames: {', '.join(others)}"
    return [told] if others else []


@dataclass(frozen=True, slots=True, eq=False)
class _ModelImage:
    """A row of images.txt: quaternion as written, translation of the camera from the world, camera, file and line."""

    q: Float
    t_m: Float
    camera: int
    where: str


def _model_images(file: Path) -> tuple[dict[str, _ModelImage], list[tuple[str, list[str]]], list[int]]:
    """Rows of images.txt by the images' names, words of the rows of their points, and lines that are neither.

    Raises:
        DatasetError: A row is of another form.
    """
    images: dict[str, _ModelImage] = {}
    seen: list[tuple[str, list[str]]] = []
    cut, last = [], None
    lines = ((line, text.split()) for line, text in numbered_lines(file) if not text.startswith("#"))
    for line, words in lines:
        if len(words) < 10 or is_number(words[9]) or not all(is_number(word) for word in words[:9]):
            if last is not None and len(words) % 3 == 0 and all(is_number(word) for word in words):
                seen.append((last, words))
            else:
                cut.append(line)
            last = None
            continue
        where, name = f"{file}:{line}", " ".join(words[9:])
        if not words[8].isdecimal():
            raise DatasetError(f"{where}: CAMERA_ID must be a whole number, not {words[8]!r}")
        if name in images:
            raise DatasetError(f"{where}: gives {name} a second pose")
        q, t_m = np.array([float(word) for word in words[1:5]]), np.array([float(word) for word in words[5:8]])
        try:
            R_from_q_wxyz(q)
        except ValueError as error:
            raise DatasetError(f"{where}: {error}") from error
        images[name], last = _ModelImage(q / np.linalg.norm(q), t_m, int(words[8]), where), name
    return images, seen, cut


def _refuse_other_order(
    place: Path, images: dict[str, _ModelImage], seen: list[tuple[str, list[str]]], lens: Lens
) -> None:
    """Refuse a model whose quaternions stand with w last.

    Raises:
        DatasetError: They do.
    """
    names = sorted(images, key=lambda name: natural(Path(name)))
    number = {name: k for k, name in enumerate(names)}
    every = max(1, len(seen) * 100 // SEEN_MAX)
    observed = [each for name, words in seen[::every] for each in seen_in(words[:300], number[name])]
    points = read_points(place / "points3D.txt") if observed else {}
    q, t_m = np.array([images[name].q for name in names]), np.array([images[name].t_m for name in names])
    why = contradicted(q, t_m, observed, points, lens.camera)
    if why is not None:
        raise DatasetError(
            f"{images[names[0]].where}: COLMAP's quaternions are QW QX QY QZ, but these must be QX QY QZ QW: {why}; "
            "write w first"
        )


def _cut_rows(file: Path, cut: list[int], count: int) -> list[str]:
    """What is to be said of rows that are neither an image nor its points, and of images that the file counts only."""
    if cut:
        more = f" (and {len(cut) - 1} others)" if len(cut) > 1 else ""
        return [f"{file}:{cut[0]}: is no whole row of an image (IMAGE_ID QW QX ... NAME) and was left out{more}"]
    said = next((int(m[1]) for _, text in numbered_lines(file) if (m := COUNTED.match(text))), count)
    return [f"{file}: says that it has {said} images, but has {count}: it may be cut off"] if said > count else []


def read_transforms(path: Path) -> Source:
    """Read `transforms.json`: intrinsics and camera-to-world matrices in OpenGL's axes.

    Raises:
        DatasetError: It is no such file, has frames without a pose, or names a lens that flocc does not read.
    """
    file = path / "transforms.json"
    try:
        table: Any = json.loads(read_text(file))
        frames = table["frames"]
        poses = {str(f["file_path"]): np.array(f["transform_matrix"], dtype=float) for f in frames}
        without = next((name for name, T in poses.items() if T.ndim != 2), None)
        if without is not None:
            raise DatasetError(f"{file}: the transform_matrix of {without} is no matrix")
        twice = next(
            (
                f["file_path"]
                for f in frames
                if not np.array_equal(
                    poses[str(f["file_path"])], np.array(f["transform_matrix"], float), equal_nan=True
                )
            ),
            None,
        )
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{file}: is no transforms.json of nerfstudio ({type(error).__name__}: {error})") from error
    if not poses:
        raise DatasetError(f"{file}: has no frames")
    if twice is not None:
        raise DatasetError(f"{file}: gives {twice} two poses")
    wrong = next((name for name, T in poses.items() if T.shape != (4, 4)), None)
    if wrong is not None:
        raise DatasetError(f"{file}: the transform_matrix of {wrong} is not 4x4")
    world = {name: checked_pose(T @ CAMERA_OF_OPENGL, f"{file}: {name}") for name, T in poses.items()}
    _refuse_other_axes(table, file)
    scale = _applied_scale(table, file)
    for T in world.values():
        T[:3, 3] /= scale
    stamps = {str(f["file_path"]): f.get("timestamp") for f in frames}
    source = _source(path, "transforms", path, world, None, file, stamps)
    scaled = f"{file}: applied_scale is {scale:g}; distances are those before it, the poses' divided by it"
    unused = sorted({key for f in frames for key in f} - FRAME_KEYS)
    told = f"{file}: not used of its frames: {', '.join(unused[:12])}"
    notes = (*source.notes, *([scaled] if scale != 1.0 else []), *([told] if unused else []))
    return replace(source, notes=notes, calibrations=(file, *camera_files(path)))


def _refuse_other_axes(table: dict[str, Any], file: Path) -> None:
    """Refuse poses that the file itself says are of other axes, or of the world in the camera.

    Raises:
        DatasetError: A key that names a convention names another one than OpenGL's camera in the world.
    """
    for key, value in table.items():
        text = f"{key} {value}".lower()
        if AXES_KEY.search(key.lower()) and value not in (None, "") and not AXES_READ.search(text):
            raise DatasetError(
                f"{file}: {key} is {str(value)[:40]!r}, but poses are read as those of a camera in the world, in "
                "OpenGL's axes (y up, z backwards): write them so, and take the key out"
            )


def _applied_scale(table: dict[str, Any], file: Path) -> float:
    """What nerfstudio multiplied distances by when it wrote the file.

    Raises:
        DatasetError: It is no length, or the applied transform is not rigid.
    """
    scale, moved = table.get("applied_scale", 1.0), table.get("applied_transform")
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < float("inf"):
        raise DatasetError(f"{file}: applied_scale must be a number above 0, not {str(scale)[:40]!r}")
    if moved is not None:
        R = np.array(moved, float)[:3, :3]
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-3):
            raise DatasetError(f"{file}: applied_transform is not rigid, so the scale of the poses is not known")
    return float(scale)


def _image_folder(path: Path) -> Path:
    return next((path / name for name in ("images", "rgb", "input") if (path / name).is_dir()), path)


def _source(
    path: Path,
    name: str,
    folder: Path,
    poses: dict[str, Float],
    lens: Lens | None,
    calibration: Path | None = None,
    stamps: dict[str, Any] | None = None,
) -> Source:
    """Images with their poses in the order of their names, and a lens, or one of a file that may not say their size."""
    found = {
        key: file
        for key in sorted(poses, key=lambda name: natural(Path(name)))
        if (file := _file(folder, key)) is not None
    }
    if not found:
        raise DatasetError(f"{folder}: has none of the {len(poses)} images, of which the first is {next(iter(poses))}")
    stamps_s, _ = stamps_of_names([Path(key).stem for key in found], folder)
    if stamps_s is None:
        stamps_s = _seconds([(stamps or {}).get(key) for key in found], path)
    invented = stamps_s is None
    stamps_s = [STEP_S * k for k in range(len(found))] if stamps_s is None else stamps_s
    order = np.argsort(stamps_s)
    stamped_s, keys = np.array(stamps_s)[order], [list(found)[k] for k in order]
    if np.any(np.diff(stamped_s) <= 0):
        raise DatasetError(f"{folder}: two images have one stamp")
    truth = Trajectory(stamped_s, np.array([poses[key] for key in keys]))
    missing = len(poses) - len(found)
    notes = [f"{path}: a reconstruction has no metric scale unless it was set; its distances are taken as metres"]
    if invented:
        notes.append(f"{path}: images have no stamps; one every {STEP_S:g} s was assumed, in the order of their names")
    others = _without_pose(folder, list(found.values()))
    if others:
        notes.append(f"{folder}: {others} more images have no pose in the model and were left out")
    if missing:
        notes.append(f"{folder}: {missing} of {len(poses)} images do not exist and were left out")
    images = tuple(zip(stamped_s.tolist(), (found[key] for key in keys), strict=True))
    if calibration is not None:
        lens = read_lens(calibration, size_of(images))
    return Source(path, name, images, lens, truth=truth, notes=tuple(notes), is_posed_by_image=True)


def _seconds(given: list[Any], path: Path) -> list[float] | None:
    """Stamps that frames give in seconds, or None where they give none.

    Raises:
        DatasetError: Some frames have none, or they cannot be seconds.
    """
    numbers = [float(stamp) for stamp in given if isinstance(stamp, int | float) and not isinstance(stamp, bool)]
    if not any(stamp is not None for stamp in given):
        return None
    step_s = float(np.median(np.diff(np.sort(numbers)))) if len(numbers) > 1 else 0.0
    if len(numbers) < len(given) or not STEP_MIN_S <= step_s <= STEP_MAX_S:
        raise DatasetError(
            f"{path / 'transforms.json'}: timestamp must be seconds in every frame; {len(numbers)} of {len(given)} "
            f"have a number, {step_s:g} apart: mend them, or leave timestamp out and name the images by their stamps"
        )
    return numbers


def _without_pose(folder: Path, found: list[Path]) -> int:
    """How many images lie beside those of a model, of the kinds that it has."""
    suffixes = {file.suffix for file in found}
    beside = {file for place in {file.parent for file in found} for file in place.iterdir() if file.suffix in suffixes}
    return len(beside - set(found) - {folder / MASK})


def _file(folder: Path, name: str) -> Path | None:
    """An image by its name, which instant-ngp writes without suffix."""
    names = (name + suffix for suffix in ("", ".png", ".jpg", ".jpeg"))
    return next((file for each in names if (file := listed_file(folder, each)) is not None), None)


def read_replica(path: Path) -> Source:
    """Read a sequence of Replica as SLAM programs render it: `results/frame*.jpg` and 4x4 rows in `traj.txt`.

    Raises:
        DatasetError: There are not as many poses as images, or `cam_params.json` cannot be read.
    """
    files = [file for file in image_files(path / "results") if file.stem.startswith("frame")]
    stamps_s = [k / REPLICA_RATE_HZ for k in range(len(files))]
    truth, notes = read_trajectory(path / "traj.txt", "kitti", stamps_s)
    images = tuple(zip(stamps_s, files, strict=True))
    place = next((p for p in (path / "cam_params.json", path.parent / "cam_params.json") if p.exists()), None)
    lens = camera_file(path, images) if place is None else read_lens(place)
    calibrations = (*([] if place is None else [place]), *camera_files(path))
    told = f"{path}: images have no stamps; {REPLICA_RATE_HZ:g} a second were assumed"
    return Source(
        path, "replica", images, lens, truth=truth, notes=(told, *notes), is_posed_by_image=True,
        calibrations=calibrations,
    )  # fmt: skip
