"""How well a perception back-end recognises and registers real images, by the same tables for every back-end.

    python -m flocc_launch.evaluate_registration ../shared/data [--recordings A B C] [--json FILE]

Every pair of views of different robots is registered, with odometry's neighbour for Eqs. (1) and (6); accepted are
those whose match ratio reaches a threshold. A registration is correct when its rotation is right within 10 degrees
and its translation, given the true length, within the scene's limit.
"""

import argparse
import json
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.composition import Perception, build_perception
from flocc_agent.config import KeyframeConfig, PerceptionConfig
from flocc_agent.core.interfaces import Describer, OdometryPair
from flocc_agent.core.registration import Registration, RegistrationFailed, match_ratio
from flocc_agent.geometry import angle_rad
from flocc_launch.registration_scenes import (
    Scene,
    corridor,
    fountain,
    from_recordings,
    loop_pairs,
    relative,
    sevenscenes,
)

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

ROTATION_ERROR_MAX_DEG = 10.0
MATCH_RATIOS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5)
SIMILARITIES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
CORRESPONDENCES_MIN = 20
"""The core refuses registrations with fewer (LoopClosingParameters.correspondences_min)."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What registering one pair gave, against the truth.

    Attributes:
        query: Number of the query view.
        match: Number of the match view.
        similarity: Cosine similarity of the descriptors.
        same_place: Whether the true poses see the same place.
        correspondences: Of the loop pair.
        ratio: Eq. (1).
        failure: Why there is no pose, or None.
        rotation_error_deg: Against the true rotation.
        direction_error_deg: Against the true direction of translation.
        position_error_m: With the translation's length made the true one.
        scale_ratio: Metric length by Eq. (6) over the true one; None without scale.
        correct: Rotation and position are within the limits.
    """

    query: int
    match: int
    similarity: float
    same_place: bool
    correspondences: int
    ratio: float
    failure: str | None = None
    rotation_error_deg: float | None = None
    direction_error_deg: float | None = None
    position_error_m: float | None = None
    scale_ratio: float | None = None
    correct: bool = False


def run(
    shared: Path | None,
    perception: PerceptionConfig | None = None,
    recordings: Sequence[Path] = (),
    keyframes: KeyframeConfig | None = None,
) -> dict[str, Any]:
    """Judge a back-end on the research sets that are there, and on recordings with ground truth.

    Args:
        shared: Folder with sevenscenes, strecha_fountain, loop_pairs and vpr_corridor; absent sets are skipped.
        perception: The back-end; None is the default.
        recordings: Robots' recordings that are registered with each other.
        keyframes: Keyframe selection for the recordings.

    Returns:
        JSON values: `method`, and by scene what `judge`, `judge_loop_pairs` and `judge_corridor` give.

    Raises:
        FloccError: A set is damaged, or the back-end cannot be built.
    """
    config = perception or PerceptionConfig()
    skills = build_perception(config)
    report: dict[str, Any] = {"method": config.method, "model": skills.encoder.model}
    if shared is not None and (shared / "sevenscenes").is_dir():
        report["sevenscenes"] = judge(sevenscenes(shared / "sevenscenes"), skills)
    if shared is not None and (shared / "strecha_fountain").is_dir():
        report["fountain"] = judge(fountain(shared / "strecha_fountain" / "fountain-P11"), skills)
    if shared is not None and (shared / "loop_pairs").is_dir():
        report["loop_pairs"] = judge_loop_pairs(shared / "loop_pairs", skills)
    if shared is not None and (shared / "vpr_corridor").is_dir():
        report["vpr_corridor"] = judge_corridor(shared / "vpr_corridor", skills.describer)
    if recordings:
        report["recordings"] = judge(from_recordings(list(recordings), keyframes or KeyframeConfig()), skills)
    return report


def judge(scene: Scene, skills: Perception) -> dict[str, Any]:
    """Register all pairs of a scene's robots and put the outcomes into tables.

    Returns:
        `views`, `pairs`, `seconds` (median per call), `all_pairs` and `best_matches` (a row per match ratio),
        `place_recognition` (recall at one, a row per similarity).
    """
    outcomes, seconds = register_all(scene, skills)
    best = best_matches(outcomes, scene)
    return {
        "views": len(scene.views),
        "pairs": len(outcomes),
        "seconds": seconds,
        "all_pairs": [ratio_row(outcomes, ratio) for ratio in MATCH_RATIOS],
        "best_matches": [ratio_row(best, ratio) for ratio in MATCH_RATIOS],
        "place_recognition": place_recognition(outcomes, best),
    }


def register_all(scene: Scene, skills: Perception) -> tuple[list[Outcome], dict[str, float]]:
    """Register every pair (query, match) of views of different robots, each unordered pair once."""
    descriptors, latents, describe_s, encode_s, register_s = [], [], [], [], []
    for view in scene.views:
        image = view.image()
        descriptor, seconds = _timed(skills.describer.describe, image)
        describe_s.append(seconds)
        latent, seconds = _timed(skills.encoder.encode, image)
        encode_s.append(seconds)
        descriptors.append(descriptor)
        latents.append(latent)
    outcomes = []
    for i, query in enumerate(scene.views):
        odometry = odometry_pair(scene, i, latents)
        for j in range(i + 1, len(scene.views)):
            match = scene.views[j]
            if match.robot == query.robot:
                continue
            result, seconds = _timed(skills.registrar.register, latents[i], latents[j], odometry)
            register_s.append(seconds)
            similarity = float(descriptors[i] @ descriptors[j])
            outcomes.append(outcome(scene, i, j, similarity, result))
    medians = zip(("describe", "encode", "register"), (describe_s, encode_s, register_s), strict=True)
    return outcomes, {name: round(float(np.median(values)), 4) for name, values in medians}


def odometry_pair(scene: Scene, i: int, latents: Sequence[bytes]) -> OdometryPair | None:
    """The query's consecutive view: the one before, or the one after a robot's first.

    Where a robot has this view only, the views beside it in the scene stand in.
    """
    views = scene.views
    same = [k for k in (i - 1, i + 1) if 0 <= k < len(views) and views[k].robot == views[i].robot]
    alone = sum(view.robot == views[i].robot for view in views) == 1
    near = [k for k in (i - 1, i + 1) if 0 <= k < len(views)]
    chosen = same or (near if alone else [])
    if not chosen:
        return None
    k = chosen[0]
    return OdometryPair(latents[k], relative(views[k].T_odom_camera, views[i].T_odom_camera), f"{scene.name} {k}-{i}")


def outcome(scene: Scene, i: int, j: int, similarity: float, result: Registration | RegistrationFailed) -> Outcome:
    """Hold one result against the truth."""
    query, match = scene.views[i], scene.views[j]
    truth = relative(query.T_world_camera, match.T_world_camera)
    distance_m = float(np.linalg.norm(truth[:3, 3]))
    viewing_angle_rad = float(np.arccos(np.clip(truth[2, 2], -1.0, 1.0)))
    same_place = distance_m < scene.place_distance_m and viewing_angle_rad < scene.place_angle_rad
    ratio = match_ratio(result.correspondences, result.odometry_correspondences)
    if isinstance(result, RegistrationFailed):
        return Outcome(i, j, similarity, same_place, result.correspondences, ratio, result.failure.value)
    T = result.T_query_match_unscaled
    length = max(float(np.linalg.norm(T[:3, 3])), 1e-9)
    rotation_deg = float(np.degrees(angle_rad(T[:3, :3].T @ truth[:3, :3])))
    cosine = float(T[:3, 3] @ truth[:3, 3]) / (length * max(distance_m, 1e-9))
    position_error_m = float(np.linalg.norm(T[:3, 3] * (distance_m / length) - truth[:3, 3]))
    scale = None if result.scale_initial is None else result.scale_initial * length / max(distance_m, 1e-9)
    return Outcome(
        i,
        j,
        similarity,
        same_place,
        result.correspondences,
        ratio,
        None,
        rotation_deg,
        float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        position_error_m,
        scale,
        rotation_deg < ROTATION_ERROR_MAX_DEG and position_error_m < scene.position_error_max_m,
    )


def best_matches(outcomes: Sequence[Outcome], scene: Scene) -> list[Outcome]:
    """Each view's most similar view of every other robot, as the core's place recognition chooses candidates."""
    best: dict[tuple[int, str], Outcome] = {}
    for found in outcomes:
        for own, other in ((found.query, found.match), (found.match, found.query)):
            key = (own, scene.views[other].robot)
            if key not in best or found.similarity > best[key].similarity:
                best[key] = found
    unique = {(found.query, found.match): found for found in best.values()}
    return [unique[key] for key in sorted(unique)]


def ratio_row(outcomes: Sequence[Outcome], ratio_min: float) -> dict[str, Any]:
    """Accepted registrations at one match ratio: counts, precision, recall and errors at the median."""
    registered = [o for o in outcomes if o.failure is None and o.correspondences >= CORRESPONDENCES_MIN]
    correct = sum(o.correct for o in registered)
    accepted = [o for o in registered if o.ratio >= ratio_min]
    right = sum(o.correct for o in accepted)
    scales = [abs(float(np.log(o.scale_ratio))) for o in accepted if o.scale_ratio]
    return {
        "match_ratio_min": ratio_min,
        "accepted": len(accepted),
        "correct": right,
        "precision": _ratio(right, len(accepted)),
        "recall": _ratio(right, correct),
        "rotation_error_median_deg": _median([o.rotation_error_deg for o in accepted]),
        "direction_error_median_deg": _median([o.direction_error_deg for o in accepted]),
        "position_error_median_m": _median([o.position_error_m for o in accepted]),
        "with_scale": len(scales),
        "scale_error_median_ratio": _median([float(np.expm1(scale)) for scale in scales]),
    }


def place_recognition(outcomes: Sequence[Outcome], best: Sequence[Outcome]) -> dict[str, Any]:
    """Recall at one over best matches, and precision and recall of a similarity threshold over all pairs.

    A best match is judged by the true poses (`same_place`) and by whether it registers correctly.
    """
    rows = []
    places = sum(o.same_place for o in outcomes)
    for similarity in SIMILARITIES:
        above = [o for o in outcomes if o.similarity >= similarity]
        right = sum(o.same_place for o in above)
        row = {"similarity_min": similarity, "pairs": len(above), "precision": _ratio(right, len(above))}
        rows.append({**row, "recall": _ratio(right, places)})
    return {
        "best_matches": len(best),
        "same_place": _ratio(sum(o.same_place for o in best), len(best)),
        "register_correctly": _ratio(sum(o.correct for o in best), len(best)),
        "similarity_median_same_place": _median([o.similarity for o in outcomes if o.same_place]),
        "similarity_median_elsewhere": _median([o.similarity for o in outcomes if not o.same_place]),
        "thresholds": rows,
    }


def judge_loop_pairs(folder: Path, skills: Perception) -> list[dict[str, Any]]:
    """Register the true revisits and the negatives of loop_pairs; the right camera is odometry's neighbour."""
    left, right = loop_pairs(folder)
    scene = Scene(folder.name, left, 1.0, float(np.radians(60.0)), 0.3)
    images = [view.image() for view in left]
    latents = [skills.encoder.encode(image) for image in images]
    descriptors = [skills.describer.describe(image) for image in images]
    rows = []
    for i in range(len(left)):
        neighbour = skills.encoder.encode(right[i].image())
        T_neighbour_query = relative(right[i].T_world_camera, left[i].T_world_camera)
        odometry = OdometryPair(neighbour, T_neighbour_query, f"{scene.name} right-{i}")
        for j in range(i + 1, len(left)):
            result = skills.registrar.register(latents[i], latents[j], odometry)
            similarity = float(descriptors[i] @ descriptors[j])
            rows.append(asdict(outcome(scene, i, j, similarity, result)))
    return rows


def judge_corridor(folder: Path, describer: Describer) -> dict[str, Any]:
    """Share of query images whose most similar reference (or one of five) is right."""
    query, reference, right = corridor(folder)
    similarity = (
        np.array([describer.describe(image) for image in query])
        @ np.array([describer.describe(image) for image in reference]).T
    )
    ranked = np.argsort(-similarity, axis=1, kind="stable")
    found = {k: [bool(right[i] & {int(j) for j in ranked[i, :k]}) for i in range(len(query))] for k in (1, 5)}
    return {"queries": len(query), "recall_at_1": float(np.mean(found[1])), "recall_at_5": float(np.mean(found[5]))}


def text(report: dict[str, Any]) -> str:
    """The report as lines for people."""
    lines = [f"method {report['method']}, model {report['model']}"]
    for name in ("sevenscenes", "fountain", "recordings"):
        if name in report:
            lines += _scene_lines(name, report[name])
    for row in report.get("loop_pairs", []):
        verdict = row["failure"] or f"rotation {row['rotation_error_deg']:.1f} deg, {_scale_text(row)}"
        counts = f"{row['correspondences']} correspondences, ratio {row['ratio']:.2f}"
        lines.append(
            f"loop_pairs {row['query']}-{row['match']}: similarity {row['similarity']:.2f}, {counts}, {verdict}"
        )
    if "vpr_corridor" in report:
        found = report["vpr_corridor"]
        lines.append(f"vpr_corridor: recall@1 {found['recall_at_1']:.3f}, recall@5 {found['recall_at_5']:.3f}")
    return "\n".join(lines)


def main() -> None:
    """Judge a back-end and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path, nargs="?", help="folder of the research sets")
    parser.add_argument("--recordings", type=Path, nargs="*", default=[], help="robots' recordings with ground truth")
    parser.add_argument("--json", type=Path, help="file to write the whole report to")
    arguments = parser.parse_args()
    report = run(arguments.shared, recordings=arguments.recordings)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(text(report) + "\n")


def _scene_lines(name: str, scene: dict[str, Any]) -> list[str]:
    places = scene["place_recognition"]
    here, elsewhere = places["similarity_median_same_place"], places["similarity_median_elsewhere"]
    lines = [
        f"{name}: {scene['views']} views, {scene['pairs']} pairs, seconds {scene['seconds']}",
        f"  best matches {places['best_matches']}: {_number(places['same_place'])} at the same place, "
        f"{_number(places['register_correctly'])} register correctly; similarity at one place "
        f"{_number(here)}, elsewhere {_number(elsewhere)}",
    ]
    columns = (
        "ratio",
        "accepted",
        "correct",
        "precision",
        "recall",
        "rot deg",
        "dir deg",
        "pos m",
        "scaled",
        "scale err",
    )
    for table in ("all_pairs", "best_matches"):
        lines.append(f"  {table}: " + " | ".join(columns))
        lines += ["    " + " | ".join(_number(value) for value in row.values()) for row in scene[table]]
    rows = [" | ".join(_number(value) for value in row.values()) for row in places["thresholds"]]
    return [*lines, "  similarity | pairs | precision | recall", *("    " + row for row in rows)]


def _scale_text(row: dict[str, Any]) -> str:
    return "no scale" if row["scale_ratio"] is None else f"length {row['scale_ratio']:.2f} of the true one"


def _number(value: float | int | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.3f}"


def _timed(function: Any, *arguments: Any) -> tuple[Any, float]:
    started_s = time.perf_counter()
    result = function(*arguments)
    return result, time.perf_counter() - started_s


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


if __name__ == "__main__":
    main()
