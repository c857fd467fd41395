"""`python -m flocc_lab.bench.overlaid_recording ../shared/data/street OUT`: data whose pictures show what is no scene.

Each picture shows what `--kind` says, the same on all robots, the same at other pixels (`--moved`), or each its own.
With `--mask` each robot's folder says so, where it does not change its place. `flocc simulate OUT` then tells what the
overlay costs, and with the mask what the lost part of the picture costs by itself; `--judge RUN...` counts the wrong
closures of such runs.
"""

import json
import shutil
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_lab.bench.drawn_overlays import KINDS, Overlay, overlay
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.right_closures import verdicts
from flocc_launch.runs.run_folder import RunFolder

JPEG_QUALITY = 92
MOVED_STEP_PX = 12
"""How much farther right, and half as much down, each next robot shows the same."""


def overlay_robot(
    source: Path, out: Path, cover: Overlay, mask: Overlay | None = None, first: int | None = None
) -> None:
    """Copy one robot's folder with covered pictures, the first ones only where so asked.

    Args:
        source: The robot's folder, of the plain layout.
        out: Where the copy is to be.
        cover: What its pictures show beside the scene.
        mask: The copy has a mask of what this one touches.
        first: Pictures that are kept.
    """
    shutil.copytree(source, out, ignore=shutil.ignore_patterns("*.npz"))
    files = sorted((out / "images").iterdir())
    for file in files[len(files) if first is None else first :]:
        file.unlink()
    for k, file in enumerate(files[:first]):
        pixels = np.asarray(cv2.imread(str(file)), np.uint8)
        file.chmod(0o644)
        cv2.imwrite(str(file), cover(pixels, k), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if mask is not None:
        hidden = touched(mask, size_of(out))
        cv2.imwrite(str(out / "mask.png"), np.where(hidden, np.uint8(0), np.uint8(255)))


def touched(cover: Overlay, size: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) pixels that an overlay changes in a picture of one colour and this width and height."""
    grey = np.full((size[1], size[0], 3), 128, np.uint8)
    return np.asarray(np.any(cover(grey, 0) != grey, axis=2))


def size_of(robot: Path) -> tuple[int, int]:
    """Width and height of a robot's pictures."""
    height, width = np.asarray(cv2.imread(str(min((robot / "images").iterdir())))).shape[:2]
    return width, height


def judged(run: Path) -> str:
    """One line on a run: closures that were accepted, wrong, and wrong in the solution; maps; error."""
    loaded = load(RunFolder(run))
    found = verdicts(loaded)
    used = {(pair.query, pair.match): pair.used for pair in loaded.pairs}
    wrong = [ends for ends, right in found.items() if not right]
    report = json.loads((run / "report.json").read_text())
    cells = (
        run.name,
        len(found),
        len(wrong),
        sum(used[ends] is not False for ends in wrong),
        len(report["map_frames"]),
        report["ate_joint_m"],
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the folder, or judge runs."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, nargs="?")
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--kind", choices=sorted(KINDS), default="bumper")
    parser.add_argument("--share", type=float, default=0.3)
    parser.add_argument("--same", action="store_true", help="all robots show the same")
    parser.add_argument("--moved", action="store_true", help="all robots show the same, at other pixels")
    parser.add_argument("--first", type=int, help="only so many pictures of each robot")
    parser.add_argument("--mask", action="store_true", help="each folder says what moves with the camera")
    parser.add_argument("--judge", type=Path, nargs="+", help="instead: run folders, a line each")
    given = parser.parse_args(arguments)
    if given.judge:
        heads = ("run", "closures", "wrong", "wrong ones used", "maps", "joint ATE, m")
        sys.stdout.write(f"| {' | '.join(heads)} |\n{'| --- ' * len(heads)}|\n")
        sys.stdout.writelines(f"{judged(run)}\n" for run in given.judge)
        return
    if given.source is None or given.out is None:
        parser.error("say what to copy, and where to")
    robots = sorted(folder for folder in given.source.iterdir() if (folder / "images").is_dir())
    for k, robot in enumerate(robots):
        seed = 0 if given.same or given.moved else k
        offset_px = (k * MOVED_STEP_PX, k * MOVED_STEP_PX // 2) if given.moved else (0, 0)
        cover = overlay(given.kind, size_of(robot), given.share, seed, offset_px)
        overlay_robot(robot, given.out / robot.name, cover, cover if given.mask else None, given.first)


if __name__ == "__main__":
    main()
