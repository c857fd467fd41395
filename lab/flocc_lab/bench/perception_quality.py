"""How well a perception back-end recognises and registers real images, by the same tables for every back-end.

    python -m flocc_lab.bench.perception_quality ../shared/data [--recordings A B C] [--json FILE]

Pairs of views of different robots are registered, with odometry's neighbour for Eqs. (1) and (6): all of them, in large
scenes the best matches, those at one place and some others. Accepted are those whose match ratio reaches a threshold.
A registration is correct when its rotation is right within 10 degrees and its translation, given the true length,
within the scene's limit.
"""

import argparse
import json
import logging
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import KeyframeConfig, PerceptionConfig
from flocc_agent.core.interfaces import Describer, OdometryPair, Perception
from flocc_agent.core.registration import Registration, RegistrationFailed, match_ratio
from flocc_agent.geometry import angle_rad
from flocc_agent.perception.backends import build_perception
from flocc_lab.bench.registration_scenes import (
    RegistrationScene,
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
PAIRS_MAX = 2000
"""Larger scenes register their best matches, and this many of the other pairs: half at one place, half drawn."""
SEED = 1
CORRESPONDENCES_MIN = 20
"""The core refuses registrations with fewer (LoopClosingParameters.correspondences_min)."""


@dataclass(frozen=True, slots=True)
class ScoredPair:
    """Two views of different robots.

    Attributes:
        query: Number of the query view.
        match: Number of the match view, the larger one.
        similarity: Cosine similarity of the descriptors.
        same_place: Whether the true poses see the same place.
    """

    query: int
    match: int
    similarity: float
    same_place: bool


@dataclass(frozen=True, slots=True)
class PairOutcome:
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
        confidence: Mean confidence of the network; None of methods without one.
        confidence_ratio: The same over the odometry pair's.
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
    confidence: float | None = None
    confidence_ratio: float | None = None


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


def judge(scene: RegistrationScene, skills: Perception) -> dict[str, Any]:
    """Register pairs of a scene's robots and put the outcomes into tables.

    Returns:
        `views`, `pairs` (registered ones), `seconds` (median per call), `all_pairs` and `best_matches` (a row per match
        ratio), `place_recognition` (best matches, a row per similarity).
    """
    descriptors, latents, seconds = encoded(scene, skills)
    pairs = cross_pairs(scene, np.array(descriptors))
    best = best_matches(pairs, scene)
    outcomes, seconds["register"] = registered(scene, chosen(pairs, best), latents, skills)
    of_best = [o for o in outcomes if (o.query, o.match) in best]
    return {
        "views": len(scene.views),
        "pairs": len(outcomes),
        "seconds": seconds,
        "all_pairs": [ratio_row(outcomes, ratio) for ratio in MATCH_RATIOS],
        "best_matches": [ratio_row(of_best, ratio) for ratio in MATCH_RATIOS],
        "place_recognition": {
            "recall_at_1": recall_at_one(pairs, scene),
            **place_recognition(pairs, of_best),
        },
    }


def encoded(
    scene: RegistrationScene, skills: Perception
) -> tuple[list[NDArray[np.float32]], list[bytes], dict[str, float]]:
    """Descriptors and latents of all views, and the median seconds of each."""
    images = (view.image() for view in scene.views)
    timed = [(_timed(skills.describer.describe, image), _timed(skills.encoder.encode, image)) for image in images]
    describe_s, encode_s = (float(np.median([pair[k][1] for pair in timed])) for k in (0, 1))
    seconds = {"describe": round(describe_s, 4), "encode": round(encode_s, 4)}
    return [described[0] for described, _ in timed], [latent[0] for _, latent in timed], seconds


def cross_pairs(scene: RegistrationScene, descriptors: NDArray[np.float32]) -> list[ScoredPair]:
    """All unordered pairs of views of different robots."""
    similarity = descriptors @ descriptors.T
    robots = [view.robot for view in scene.views]
    numbers = range(len(robots))
    unlike = [(i, j) for i in numbers for j in numbers if i < j and robots[i] != robots[j]]
    return [ScoredPair(i, j, float(similarity[i, j]), is_same_place(scene, i, j)) for i, j in unlike]


def is_same_place(scene: RegistrationScene, i: int, j: int) -> bool:
    """Whether the true poses of two views are near and look the same way."""
    truth = relative(scene.views[i].T_world_camera, scene.views[j].T_world_camera)
    viewing_angle_rad = float(np.arccos(np.clip(truth[2, 2], -1.0, 1.0)))
    near = float(np.linalg.norm(truth[:3, 3])) < scene.place_distance_m
    return near and viewing_angle_rad < scene.place_angle_rad


def best_by_view(pairs: Sequence[ScoredPair], scene: RegistrationScene) -> dict[tuple[int, str], ScoredPair]:
    """Each view's most similar view of every other robot, by view and robot."""
    best: dict[tuple[int, str], ScoredPair] = {}
    for key, pair in _by_view_and_robot(pairs, scene):
        if key not in best or pair.similarity > best[key].similarity:
            best[key] = pair
    return best


def best_matches(pairs: Sequence[ScoredPair], scene: RegistrationScene) -> set[tuple[int, int]]:
    """The pairs that the core's place recognition would choose as candidates."""
    return {(pair.query, pair.match) for pair in best_by_view(pairs, scene).values()}


def recall_at_one(pairs: Sequence[ScoredPair], scene: RegistrationScene) -> float | None:
    """Share of best matches at one place, of the views and robots where that robot was at the view's place."""
    return _ratio(*recalled(pairs, scene))


def recalled(pairs: Sequence[ScoredPair], scene: RegistrationScene) -> tuple[int, int]:
    """Numerator and denominator of `recall_at_one`."""
    possible = {key for key, pair in _by_view_and_robot(pairs, scene) if pair.same_place}
    best = best_by_view(pairs, scene)
    return sum(best[key].same_place for key in possible), len(possible)


def chosen(pairs: Sequence[ScoredPair], best: set[tuple[int, int]]) -> list[ScoredPair]:
    """The pairs to register: all, or where they are too many the best matches and a sample of the rest."""
    if len(pairs) <= PAIRS_MAX:
        return list(pairs)
    rng = np.random.default_rng(SEED)
    kept = {k for k, pair in enumerate(pairs) if (pair.query, pair.match) in best}
    for same_place in (True, False):
        rest = [k for k, pair in enumerate(pairs) if k not in kept and pair.same_place == same_place]
        kept |= {int(k) for k in rng.choice(rest, min(len(rest), PAIRS_MAX // 2), replace=False)}
    return [pairs[k] for k in sorted(kept)]


def registered(
    scene: RegistrationScene, pairs: Sequence[ScoredPair], latents: Sequence[bytes], skills: Perception
) -> tuple[list[PairOutcome], float]:
    """Register pairs; their outcomes and the median seconds."""
    outcomes, seconds = [], []
    for pair in pairs:
        odometry = odometry_pair(scene, pair.query, latents)
        query, match = latents[pair.query], latents[pair.match]
        result, took_s = _timed(skills.registrar.register, query, match, odometry)
        outcomes.append(outcome(scene, pair, result))
        seconds.append(took_s)
    return outcomes, round(float(np.median(seconds)), 4) if seconds else 0.0


def odometry_pair(scene: RegistrationScene, i: int, latents: Sequence[bytes]) -> OdometryPair | None:
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


def outcome(scene: RegistrationScene, pair: ScoredPair, result: Registration | RegistrationFailed) -> PairOutcome:
    """Hold one result against the truth."""
    truth = relative(scene.views[pair.query].T_world_camera, scene.views[pair.match].T_world_camera)
    distance_m = float(np.linalg.norm(truth[:3, 3]))
    given = (pair.query, pair.match, pair.similarity, pair.same_place, result.correspondences)
    ratio = match_ratio(result.correspondences, result.odometry_correspondences)
    if isinstance(result, RegistrationFailed):
        return PairOutcome(*given, ratio, result.failure.value)
    T = result.T_query_match_unscaled
    length = max(float(np.linalg.norm(T[:3, 3])), 1e-9)
    rotation_deg = float(np.degrees(angle_rad(T[:3, :3].T @ truth[:3, :3])))
    cosine = float(T[:3, 3] @ truth[:3, 3]) / (length * max(distance_m, 1e-9))
    position_error_m = float(np.linalg.norm(T[:3, 3] * (distance_m / length) - truth[:3, 3]))
    scale = None if result.scale_initial is None else result.scale_initial * length / max(distance_m, 1e-9)
    return PairOutcome(
        *given,
        ratio,
        None,
        rotation_deg,
        float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        position_error_m,
        scale,
        rotation_deg < ROTATION_ERROR_MAX_DEG and position_error_m < scene.position_error_max_m,
        result.confidence,
        confidence_ratio(result),
    )


def confidence_ratio(result: Registration) -> float | None:
    """The network's mean confidence in the loop pair over that in the odometry pair, None without both."""
    if result.confidence is None or result.odometry_confidence is None:
        return None
    return result.confidence / result.odometry_confidence


def ratio_row(outcomes: Sequence[PairOutcome], ratio_min: float) -> dict[str, Any]:
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


def place_recognition(pairs: Sequence[ScoredPair], best: Sequence[PairOutcome]) -> dict[str, Any]:
    """How often best matches are right, and precision and recall of a similarity threshold over all pairs.

    A best match is judged by the true poses (`same_place`) and by whether it registers correctly.
    """
    rows = []
    places = [pair.similarity for pair in pairs if pair.same_place]
    elsewhere = [pair.similarity for pair in pairs if not pair.same_place]
    for similarity in SIMILARITIES:
        right = sum(s >= similarity for s in places)
        above = right + sum(s >= similarity for s in elsewhere)
        row = {"similarity_min": similarity, "pairs": above, "precision": _ratio(right, above)}
        rows.append({**row, "recall": _ratio(right, len(places))})
    return {
        "best_matches": len(best),
        "same_place": _ratio(sum(o.same_place for o in best), len(best)),
        "register_correctly": _ratio(sum(o.correct for o in best), len(best)),
        "similarity_median_same_place": _median(places),
        "similarity_median_elsewhere": _median(elsewhere),
        "thresholds": rows,
    }


def judge_loop_pairs(folder: Path, skills: Perception) -> list[dict[str, Any]]:
    """Register the true revisits and the negatives of loop_pairs; the right camera is odometry's neighbour."""
    left, right = loop_pairs(folder)
    scene = RegistrationScene(folder.name, left, 1.0, float(np.radians(60.0)), 0.3)
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
            pair = ScoredPair(i, j, float(descriptors[i] @ descriptors[j]), is_same_place(scene, i, j))
            rows.append(asdict(outcome(scene, pair, result)))
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


def _by_view_and_robot(
    pairs: Sequence[ScoredPair], scene: RegistrationScene
) -> Iterator[tuple[tuple[int, str], ScoredPair]]:
    """Every pair twice: for its one view and the other's robot, and the other way round."""
    for pair in pairs:
        yield (pair.query, scene.views[pair.match].robot), pair
        yield (pair.match, scene.views[pair.query].robot), pair


def _scene_lines(name: str, scene: dict[str, Any]) -> list[str]:
    places = scene["place_recognition"]
    here, elsewhere = places["similarity_median_same_place"], places["similarity_median_elsewhere"]
    lines = [
        f"{name}: {scene['views']} views, {scene['pairs']} pairs, seconds {scene['seconds']}",
        f"  recall@1 {_number(places['recall_at_1'])}; best matches {places['best_matches']}: "
        f"{_number(places['same_place'])} at the same place, "
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
