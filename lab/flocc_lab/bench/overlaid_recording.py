"""`python -m flocc_lab.bench.overlaid_recording ../shared/data/street OUT`: data whose robots see themselves.

The lower part of each picture shows a bumper that moves with the camera, the same on all robots or each its own. With
`--mask` each robot's folder says so. `flocc simulate OUT` then tells what the overlay costs, and with the mask what
the lost part of the picture costs by itself.
"""

import shutil
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

BLOCK_PX = 8
JPEG_QUALITY = 92


def bumper(width: int, rows: int, seed: int) -> Bytes:
    """What a robot shows of itself, (rows, width) grey, full of corners."""
    blocks = np.random.default_rng(seed).integers(0, 256, (max(rows // BLOCK_PX, 2), width // BLOCK_PX), dtype=np.uint8)
    return np.asarray(cv2.resize(blocks, (width, rows), interpolation=cv2.INTER_CUBIC), np.uint8)


def covered(pixels: Bytes, share: float, seed: int) -> Bytes:
    """A picture (H, W, 3) whose lower part is the bumper."""
    height, width = pixels.shape[:2]
    rows = round(height * share)
    shown = np.repeat(bumper(width, rows, seed)[..., None], 3, axis=2)
    return np.concatenate([pixels[: height - rows], shown])


def overlay_robot(source: Path, out: Path, share: float, seed: int, with_mask: bool) -> None:
    """Copy one robot's folder with covered pictures."""
    shutil.copytree(source, out, ignore=shutil.ignore_patterns("*.npz"))
    size = (0, 0)
    for file in sorted((out / "images").iterdir()):
        pixels = np.asarray(cv2.imread(str(file)), np.uint8)
        size = pixels.shape[1], pixels.shape[0]
        file.chmod(0o644)
        cv2.imwrite(str(file), covered(pixels, share, seed), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if with_mask:
        mask = np.full((size[1], size[0]), 255, np.uint8)
        mask[size[1] - round(size[1] * share) :] = 0
        cv2.imwrite(str(out / "mask.png"), mask)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the folder."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--share", type=float, default=0.3)
    parser.add_argument("--same", action="store_true", help="all robots show the same")
    parser.add_argument("--mask", action="store_true", help="each folder says what moves with the camera")
    given = parser.parse_args(arguments)
    robots = sorted(folder for folder in given.source.iterdir() if (folder / "images").is_dir())
    for k, robot in enumerate(robots):
        overlay_robot(robot, given.out / robot.name, given.share, 0 if given.same else k, given.mask)


if __name__ == "__main__":
    main()
