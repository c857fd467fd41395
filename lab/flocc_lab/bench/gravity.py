"""`python -m flocc_lab.bench.gravity ../shared/data --front-end classical`: what it gains to know roll and pitch.

The same pairs are registered twice, by cameras that know which way is up and by cameras that do not. Up is a direction
that all views of a scene share (the mean of their own), turned by a drawn error of so many degrees in each view.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import so3_exp
from flocc_agent.perception.backends import build_perception
from flocc_agent.perception.classical.sift_registrar import ACCEPTANCE as CLASSICAL
from flocc_agent.perception.latent import pack, unpack, with_up
from flocc_agent.perception.multiview.acceptance import Acceptance
from flocc_agent.perception.multiview.registrar import PairRegistrar
from flocc_lab.bench.acceptance_fit import accepts
from flocc_lab.bench.acceptance_rows import (
    AcceptanceRow,
    JudgedScene,
    cached_latents,
    chosen_pairs,
    judged_scenes,
    perception_of,
    read_rows,
    row,
    write_rows,
)

Float = NDArray[np.float64]

ANGLES_DEG = (0.0, 30.0, 60.0, 90.0, 181.0)
SEED = 16
WITHOUT, WITH = "without", "with"
HEADER = "| pairs | number | right poses without | with gravity | accepted without, right + wrong | with |"


def ups_of(judged: JudgedScene, sigma_deg: float) -> list[Float]:
    """(3,) direction against gravity in each view's camera frame, with an error of its own."""
    views = judged.scene.views
    up_world = -np.mean([view.T_world_camera[:3, 1] for view in views], axis=0)
    up_world /= np.linalg.norm(up_world)
    rng = np.random.default_rng(SEED)
    errors = np.radians(sigma_deg) * rng.normal(size=(len(views), 3))
    return [
        so3_exp(error) @ view.T_world_camera[:3, :3].T @ up_world for view, error in zip(views, errors, strict=True)
    ]


def with_ups(latents: Sequence[bytes], model: str, ups: Sequence[Float]) -> list[bytes]:
    """The latents as cameras write them that know which way is up; b'' stays."""
    read = [unpack(latent, model) if latent else None for latent in latents]
    return [
        b"" if one is None else pack(model, with_up(one.header, up), one.arrays)
        for one, up in zip(read, ups, strict=True)
    ]


def rows_by_knowledge(
    judged: JudgedScene, front_end: str, pairs_max: int, angle_min_deg: float, sigma_deg: float, cache: Path
) -> dict[str, list[AcceptanceRow]]:
    """The same pairs without and with gravity."""
    pairs = [pair for pair in chosen_pairs(judged, pairs_max, cache) if angle_deg(judged, *pair[:2]) >= angle_min_deg]
    wanted = sorted({k for i, j, _ in pairs for k in (i - 1, i, i + 1, j) if 0 <= k < len(judged.scene.views)})
    skills = build_perception(perception_of(front_end))
    latents = cached_latents(judged.scene, wanted, skills, cache)
    upright = with_ups(latents, skills.encoder.model, ups_of(judged, sigma_deg))
    found = {}
    for name, these in ((WITHOUT, latents), (WITH, upright)):
        registrar = build_perception(perception_of(front_end)).registrar  # a registrar keeps odometry pairs
        assert isinstance(registrar, PairRegistrar)
        found[name] = [row(judged, i, j, is_candidate, registrar, these) for i, j, is_candidate in pairs]
    return found


def angle_deg(judged: JudgedScene, i: int, j: int) -> float:
    """Angle between the true viewing directions of two views."""
    axes = [judged.scene.views[k].T_world_camera[:3, 2] for k in (i, j)]
    return float(np.degrees(np.arccos(np.clip(axes[0] @ axes[1], -1.0, 1.0))))


def rule_of(front_end: str) -> Acceptance:
    """The rule in use."""
    if front_end == "classical":
        return CLASSICAL
    from flocc_agent.perception.learned.acceptance_by_model import ACCEPTANCE

    return ACCEPTANCE[front_end]


def line(name: str, rows: dict[str, list[AcceptanceRow]], rule: Acceptance) -> str:
    """Pairs, right poses without and with gravity, and accepted ones: right + wrong."""
    cells = [name, str(len(rows[WITHOUT]))]
    cells += [str(sum(one.is_right for one in rows[which])) for which in (WITHOUT, WITH)]
    for which in (WITHOUT, WITH):
        accepted = [one.is_right for one in rows[which] if accepts(one, rule)]
        cells.append(f"{sum(accepted)} + {len(accepted) - sum(accepted)}")
    return f"| {' | '.join(cells)} |"


def table(rows: dict[str, list[AcceptanceRow]], rule: Acceptance) -> str:
    """By scene and by angle, as Markdown."""
    lines = [HEADER, "| --- " * HEADER.count(" | ") + "| --- |"]
    scenes = sorted({one.scene for one in rows[WITHOUT]})
    lines += [line(s, {k: [one for one in v if one.scene == s] for k, v in rows.items()}, rule) for s in scenes]
    for low, high in pairwise(ANGLES_DEG):
        of_bin = {k: [one for one in v if low <= one.angle_deg < high] for k, v in rows.items()}
        lines.append(line(f"{low:.0f} to {min(high, 180.0):.0f} degrees", of_bin, rule))
    return "\n".join([*lines, line("all", rows, rule)])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--front-end", default="classical")
    parser.add_argument("--recordings", type=Path, action="append", default=[])
    parser.add_argument("--scene", action="append", default=[], help="only these")
    parser.add_argument("--pairs", type=int, default=100, help="of a scene, before the angle is looked at")
    parser.add_argument("--angle-min", type=float, default=0.0, help="degrees")
    parser.add_argument("--sigma", type=float, default=1.0, help="error of each view's up, degrees about each axis")
    parser.add_argument("--out", type=Path, default=Path("runs") / "gravity", help="latents and rows are kept here")
    given = parser.parse_args(arguments)
    rows: dict[str, list[AcceptanceRow]] = {WITHOUT: [], WITH: []}
    for judged in judged_scenes(given.shared, given.recordings):
        if given.scene and judged.scene.name not in given.scene:
            continue
        paths = {
            which: given.out / "gravity" / which / given.front_end / f"{judged.scene.name}.jsonl" for which in rows
        }
        if not all(path.exists() for path in paths.values()):
            found = rows_by_knowledge(
                judged, given.front_end, given.pairs, given.angle_min, given.sigma, given.out / "latents"
            )
            for which, path in paths.items():
                write_rows(found[which], path)
        for which, path in paths.items():
            rows[which] += read_rows(path)
    sys.stdout.write(f"{table(rows, rule_of(given.front_end))}\n")


if __name__ == "__main__":
    main()
