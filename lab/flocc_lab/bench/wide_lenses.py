"""`python -m flocc_lab.bench.wide_lenses ../shared/data/street OUT`: what a wide lens costs, on the part both see.

Each robot's pictures are remapped to a lens of each kind (`flocc_lab.dialects.wide_pictures`), converted with the field
of view that its own camera has, and run with `flocc simulate` on the same odometry. A row tells the closures and the
joint ATE of each seed, and their means over those of the own pinhole. The control (`eucm`, a pinhole) tells what the
two interpolations do alone. With `--finer 2` all pictures, the own ones as well, first get twice the pixels a side, so
that interpolation dulls none of them. A data set of one robot is cut into three.
"""

import json
import math
import shutil
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flocc_agent.lenses import LensKind
from flocc_lab.dialects.wide_pictures import write_enlarged, write_wide
from flocc_launch.datasets.commands import convert, split
from flocc_launch.datasets.detect import read_source, team_folder

KINDS = (LensKind.EUCM, LensKind.EQUIDISTANT, LensKind.DOUBLE_SPHERE)
ROBOTS = 3


def prepared(source: Path, out: Path, kinds: Sequence[LensKind], finer: int = 1) -> dict[str, Path]:
    """Write a folder of recordings of the own pinhole and of each kind; returns them by name.

    Args:
        source: The data set, or a folder of one for each robot.
        out: Gets the folders.
        kinds: Of lenses.
        finer: So many times the pixels a side, of the own pinhole as well.
    """
    own = out / ("pinhole" if finer == 1 else "source")
    team = team_folder(source)
    for name, folder in team.items():
        if not (own / name).exists():
            shutil.copytree(folder, own / name, ignore=shutil.ignore_patterns("*.npz"))
    if not team and not own.exists():
        split(source, own, ROBOTS)
    robots = sorted(path for path in own.iterdir() if path.is_dir())
    folders = {"pinhole": out / "pinhole"}
    for robot in robots if finer != 1 else ():
        convert(write_enlarged(robot, out / "pinhole-larger" / robot.name, finer), out / "pinhole" / robot.name)
    for kind in kinds:
        folders[str(kind)] = out / str(kind)
        for robot in robots:
            _remapped(robot, out / f"{kind}-wide" / robot.name, out / str(kind) / robot.name, kind, finer)
    return folders


def _remapped(robot: Path, wide: Path, out: Path, kind: LensKind, finer: int) -> None:
    """Write one robot's pictures as of a wide lens, and the recording that flocc makes of them."""
    lens = read_source(robot).lens
    assert lens is not None
    view_deg = 2 * math.degrees(math.atan(lens.camera.width / 2 / lens.camera.fx))
    shutil.rmtree(out, ignore_errors=True)
    write_wide(robot, wide, kind, finer)
    convert(wide, out, view_deg=math.floor(10 * view_deg) / 10)


def measured(folder: Path, runs: Path, seed: int) -> tuple[int, float]:
    """Closures and joint ATE in metres of one simulated run."""
    out = runs / f"{folder.name}-{seed}"
    flocc = Path(sys.executable).with_name("flocc")
    subprocess.run([flocc, "simulate", folder, "--out", out, "--seed", str(seed), "--quiet"], check=True)
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    return int(report["closures"]["accepted"]), float(report["ate_joint_m"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kinds", type=LensKind, nargs="*", default=list(KINDS))
    parser.add_argument("--finer", type=int, default=1, help="so many times the pixels a side, of all")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    options = parser.parse_args(arguments)
    own: tuple[float, float] | None = None
    for name, folder in prepared(options.source, options.out, options.kinds, options.finer).items():
        found = np.array([measured(folder, options.out / "runs", seed) for seed in options.seeds])
        closures, ate_m = found.mean(axis=0)
        own = own or (closures, ate_m)
        each = ", ".join(f"{int(count)}" for count in found[:, 0]), ", ".join(f"{ate:.4f}" for ate in found[:, 1])
        ratios = f"{closures / own[0]:.3f} | {ate_m / own[1]:.3f}"
        sys.stdout.write(f"| {name} | {each[0]} | {each[1]} | {ratios} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
