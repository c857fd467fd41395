"""What lies in a data set's folder and nobody reads: calibrations beside the one that is used, mountings, cameras.

A reader that takes what it knows and passes over the rest in silence gives a wrong camera where the rest was meant.
"""

import re
from pathlib import Path

from flocc_agent.runtime.measurement_file import NAME as MEASUREMENTS
from flocc_agent.runtime.recording import MASK
from flocc_launch.datasets.files import camera_files
from flocc_launch.datasets.plain import (
    BESIDE_READ,
    LISTINGS,
    ODOMETRY_STEMS,
    TIMES,
    TRUTH_STEMS,
    odometry_stems,
    trajectory_files,
)
from flocc_launch.datasets.source import Source

OWN_NAMES = {
    "euroc": r"state_groundtruth|mocap0|gt0|vicon0|cam0$|dso$|mav0$",
    "kitti": r"times\.txt$|poses\.txt$|image_[0-3lr]$",
    "kitti-raw": r"image_0[0-3]$|calib_cam_to_cam\.txt$|oxts$",
    "7scenes": r"frame-",
    "tum": r"rgb\.txt$|groundtruth\.txt$",
    "colmap": r"sparse$|colmap|cameras\.txt$|images\.txt$|points3D\.txt$|(rigs|frames)\.txt$",
    "transforms": r"transforms\.json$",
    "replica": r"results$|traj\.txt$",
}
"""By format, names of what its reader uses of a data set, or tells of by itself."""
OF_RECORDINGS = (MASK, MEASUREMENTS, "source.txt", "odometry_made.txt")
SHOWN_MAX = 8


def unused(source: Source, *given: Path | None) -> tuple[str, ...]:
    """What lies in a data set's folder and is not used, in at most one sentence.

    Args:
        source: As it was read.
        given: Files that are used because a person named them.
    """
    root, mav = source.path, source.path / "mav0"
    used = {file.relative_to(root).parts[0] for _, file in source.images if file.is_relative_to(root)}
    used |= {file.name for file in given if file is not None and file.parent.resolve() == root.resolve()}
    used |= set(OF_RECORDINGS) | {
        file.relative_to(root).parts[0].partition("#")[0] for file in source.calibrations if root in file.parents
    }
    if source.format == "plain":
        used |= _taken_by_plain(root)
    else:
        own = re.compile(OWN_NAMES[source.format])
        stems = (*odometry_stems(source.format), *(TRUTH_STEMS if source.format in BESIDE_READ else ()))
        used |= {file.name for file in trajectory_files(root, stems)}
        used |= {
            entry.name for place in (root, mav) if place.is_dir() for entry in place.iterdir() if own.match(entry.name)
        }
    inside = mav.iterdir() if mav.is_dir() else ()
    entries = sorted(dict.fromkeys(entry.name for entry in (*root.iterdir(), *inside)))
    others = [name for name in entries if name[0] != "." and name not in used]
    more = f" and {len(others) - SHOWN_MAX} more" if len(others) > SHOWN_MAX else ""
    return (f"{root}: not used: {', '.join(others[:SHOWN_MAX])}{more}",) if others else ()


def _taken_by_plain(root: Path) -> set[str]:
    """Names of what the reader of plain folders takes beside images, or tells of by itself."""
    files = [*camera_files(root), *trajectory_files(root, ODOMETRY_STEMS), *trajectory_files(root, TRUTH_STEMS)]
    listings = [name for name in LISTINGS if (root / name).exists()][:1]
    times = [] if listings else [name for name in TIMES if (root / name).exists()][:1]
    return {*OF_RECORDINGS, *listings, *times, *(file.name for file in files)}
