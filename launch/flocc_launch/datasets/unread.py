"""What lies in a data set's folder and nobody reads: calibrations beside the one that is used, mountings, cameras.

A reader that takes what it knows and passes over the rest in silence gives a wrong camera where the rest was meant.
"""

import re
from pathlib import Path

from flocc_agent.runtime.measurement_file import NAME as MEASUREMENTS
from flocc_agent.runtime.recording import MASK
from flocc_launch.datasets.files import camera_files
from flocc_launch.datasets.plain import LISTINGS, ODOMETRY_STEMS, TIMES, TRUTH_STEMS, trajectory_files
from flocc_launch.datasets.source import Source

USED_NAMES = re.compile(
    r"(odometry|trajectory|poses|vio|groundtruth|gt|ground_truth|traj|images|rgb|times|source|odometry_made)"
    r"\.(tum|txt|csv)$|state_groundtruth|mocap0|camera|calib|intrinsics|sensor|transforms\.json$|sparse$|frame-",
    re.IGNORECASE,
)
"""Names of what readers of published data sets use beside images."""
OF_RECORDINGS = (MASK, MEASUREMENTS, "source.txt", "odometry_made.txt")
SHOWN_MAX = 8


def unused(source: Source, *given: Path | None) -> tuple[str, ...]:
    """What lies in a data set's folder and is not used, in at most one sentence.

    Args:
        source: As it was read.
        given: Files that are used because a person named them.
    """
    root = source.path / "mav0" if (source.path / "mav0").is_dir() else source.path
    used = {file.relative_to(root).parts[0] for _, file in source.images if file.is_relative_to(root)}
    used |= {file.name for file in given if file is not None and file.parent.resolve() == root.resolve()}
    entries = [entry.name for entry in sorted(root.iterdir()) if entry.name[0] != "." and entry.name not in used]
    if source.format == "plain":
        taken = _taken_by_plain(root)
        others = [name for name in entries if name not in taken]
    else:
        others = [name for name in entries if name not in OF_RECORDINGS and not USED_NAMES.match(name)]
    more = f" and {len(others) - SHOWN_MAX} more" if len(others) > SHOWN_MAX else ""
    return (f"{root}: not used: {', '.join(others[:SHOWN_MAX])}{more}",) if others else ()


def _taken_by_plain(root: Path) -> set[str]:
    """Names of what the reader of plain folders takes beside images, or tells of by itself."""
    files = [*camera_files(root), *trajectory_files(root, ODOMETRY_STEMS), *trajectory_files(root, TRUTH_STEMS)]
    listings = [name for name in LISTINGS if (root / name).exists()][:1]
    times = [] if listings else [name for name in TIMES if (root / name).exists()][:1]
    return {*OF_RECORDINGS, *listings, *times, *(file.name for file in files)}
