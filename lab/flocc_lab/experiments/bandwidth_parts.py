"""The four measurements of the bandwidth experiment: each gives forms with their bytes and what is measured on them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from flocc_agent.config import PerceptionConfig, SyntheticConfig
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_lab.bench.perception_quality import (
    PairOutcome,
    ScoredPair,
    cross_pairs,
    is_same_place,
    odometry_pair,
    outcome,
    recalled,
)
from flocc_lab.bench.registration_scenes import RegistrationScene
from flocc_lab.experiments.experiment import Row
from flocc_lab.experiments.keyed_engine import SIZES_PX, keyed_engine, keyed_pictures
from flocc_lab.experiments.reductions import Basis, keypoint_forms, latent_forms, reduced_descriptors
from flocc_lab.experiments.registration_data import (
    Encoded,
    RegistrationData,
    RegistrationSettings,
    distance_m,
    near_pairs,
)
from flocc_lab.experiments.simulated import simulated
from flocc_lab.experiments.statistics import middle
from flocc_launch.scenarios.scenario import Scenario, TracksScenario

if TYPE_CHECKING:
    from flocc_agent.perception.classical.features import Features

KINDS = ("latent", "records", "correction", "heartbeat", "candidates")
"""Kinds of messages that are told apart; the others together are next to nothing."""
WALKERS, AREA_M = 3, 12.0
VIEWS_MIN = 20
"""A robot with fewer views is no pass through a place."""
DESCRIPTORS_LEARNED = 20_000


def form(name: str, size: float | None, **measures: float | None) -> Row:
    """One form: its bytes, and what is measured with it."""
    return {"form": name, "bytes": size, **measures}


def bytes_by_kind(latent_bytes: int, length_m: float, seed: int) -> list[Row]:
    """Bytes of a swarm per closure gained, all together and by kind of message."""
    perception = PerceptionConfig(method="synthetic", synthetic=SyntheticConfig(latent_bytes=latent_bytes))
    tracks = TracksScenario(robots=WALKERS, seed=seed, area_m=AREA_M, length_m=length_m)
    report = simulated(Scenario(name="bandwidth", seed=seed, tracks=tracks, perception=perception), seed).report
    gained = report.closures.accepted_inter_robot

    def per_closure(count: int) -> float | None:
        return count / gained if gained else None

    whole = form("all", sum(report.bytes.values()), bytes_per_closure=per_closure(sum(report.bytes.values())))
    counted = {kind: report.bytes.get(kind, 0) for kind in KINDS}
    counted["others"] = sum(report.bytes.values()) - sum(counted.values())
    kinds = [form(kind, n, bytes_per_closure=per_closure(n)) for kind, n in counted.items()]
    return [{**row, "closures": gained} for row in [whole, *kinds]]


@dataclass(frozen=True, slots=True)
class Meeting:
    """Two robots that are compared, and a third one on whose views bases are learned.

    Attributes:
        views: Numbers of the two robots' views in the scene.
        learned: Numbers of the third robot's views.
    """

    views: tuple[int, ...]
    learned: tuple[int, ...]


def meetings(scene: RegistrationScene) -> list[Meeting]:
    """Every pair of robots of a scene with many views."""
    by_robot: dict[str, list[int]] = {}
    for k, view in enumerate(scene.views):
        by_robot.setdefault(view.robot, []).append(k)
    robots = sorted(robot for robot, views in by_robot.items() if len(views) >= VIEWS_MIN)
    found = []
    for a, b in combinations(robots, 2):
        others = [robot for robot in robots if robot not in (a, b)]
        if others:
            found.append(Meeting((*by_robot[a], *by_robot[b]), tuple(by_robot[others[0]])))
    return found


def descriptor_forms(data: RegistrationData, name: str) -> list[Row]:
    """Recall@1 between robots on whose descriptors nothing was learned."""
    scene, encoded = data.scenes[name], data.encoded[name]
    described = np.array([encoded.descriptor(k) for k in range(len(scene.views))])
    sizes: dict[str, int] = {}
    found: dict[str, list[tuple[int, int]]] = {}
    for meeting in meetings(scene):
        part = replace(scene, views=tuple(scene.views[k] for k in meeting.views))
        forms = reduced_descriptors(described[list(meeting.views)], Basis.of(described[list(meeting.learned)]))
        for form_name, (size, values) in forms.items():
            sizes[form_name] = size
            found.setdefault(form_name, []).append(recalled(cross_pairs(part, values.astype(np.float32)), part))
    counted = {form_name: np.sum(hits, axis=0) for form_name, hits in found.items()}
    return [
        form(form_name, sizes[form_name], recall_at_1=float(right / possible), views=int(possible))
        for form_name, (right, possible) in counted.items()
        if possible
    ]


def keypoint_accuracy(data: RegistrationData, name: str, pairs: int, seed: int) -> list[Row]:
    """Right registrations of drawn pairs at one place, with every form of the match's latent."""
    scene, encoded = data.scenes[name], data.encoded[name]
    near = near_pairs(scene, distance_m(RegistrationSettings(), scene))
    outcomes: dict[str, list[PairOutcome]] = {}
    sizes: dict[str, list[int]] = {}
    for meeting in meetings(scene):
        forms = keypoint_forms(_descriptor_basis(encoded, meeting.learned))
        places = [(i, j) for i, j in near if {i, j} <= set(meeting.views) and is_same_place(scene, i, j)]
        rng = np.random.default_rng(seed)
        for k in sorted(rng.choice(len(places), min(pairs, len(places)), replace=False)):
            pair = encoded.pair(*places[k])
            for form_name, reduce in forms.items():
                size, result = _registered(data, scene, encoded, pair, reduce)
                outcomes.setdefault(form_name, []).append(outcome(scene, pair, result))
                sizes.setdefault(form_name, []).append(size)
    return [form(each, float(np.mean(sizes[each])), **accuracy(found)) for each, found in outcomes.items()]


def _descriptor_basis(encoded: Encoded, views: Sequence[int]) -> Basis:
    """Principal directions of local descriptors."""
    from flocc_agent.perception.classical.encoder import decode_features

    samples = np.concatenate([decode_features(encoded[k]).descriptors for k in views])
    return Basis.of(samples[:: max(1, len(samples) // DESCRIPTORS_LEARNED)])


def _registered(
    data: RegistrationData,
    scene: RegistrationScene,
    encoded: Encoded,
    pair: ScoredPair,
    reduce: "Callable[[Features], tuple[int, Features]]",
) -> tuple[int, Registration | RegistrationFailed]:
    """Register a pair of which the match's latent travelled in another form; gives its bytes too."""
    from flocc_agent.perception.classical.encoder import decode_features, encode_features

    size, features = reduce(decode_features(encoded[pair.match]))
    odometry = odometry_pair(scene, pair.query, encoded)
    return size, data.skills.register(encoded[pair.query], encode_features(features, {}), odometry)


def accuracy(outcomes: Sequence[PairOutcome]) -> dict[str, float | None]:
    """How many registrations come out right, and how right those are."""
    posed = [o for o in outcomes if o.failure is None]
    right = [o for o in posed if o.correct]
    errors = [o.direction_error_deg for o in right if o.direction_error_deg is not None]
    return {
        "pairs": len(outcomes),
        "right": len(right),
        "precision": len(right) / len(posed) if posed else None,
        "direction_error_deg": float(np.median(errors)) if errors else None,
    }


def latent_accuracy(network: Literal["tiny", "small", "full"], pictures: int) -> list[Row]:
    """Errors of what the decoder makes of reduced latents, against unreduced ones; no pose can be judged."""
    from flocc_agent.perception.mast3r.pair import match_pair
    from flocc_agent.perception.mast3r.reciprocal_matching import MatchParameters
    from flocc_agent.perception.mast3r.relative_pose import PoseFailed

    engine, size = keyed_engine(network, exact=True), SIZES_PX[network]
    latents = [latent[0].float().cpu().numpy() for latent in engine.encode(keyed_pictures(size, pictures))]
    rows: dict[str, list[Row]] = {}
    for query, match in pairwise(latents):
        reference = None
        for name, (count, reduced) in latent_forms(match).items():
            views = engine.decode([(engine.place(query, size), engine.place(reduced, size))])[0]
            points = [view.pts3d.float().cpu().numpy() for view in views]
            matches = match_pair(views, MatchParameters())
            found = set() if isinstance(matches, PoseFailed) else set(map(tuple, np.hstack([matches.xy1, matches.xy2])))
            reference = reference or (points, found)
            error = np.linalg.norm(np.subtract(points, reference[0])) / np.linalg.norm(reference[0])
            same = len(found & reference[1]) / max(len(reference[1]), 1)
            rows.setdefault(name, []).append({"bytes": count, "pointmap_error": error, "same_matches": same})
    return [
        form(name, of_form[0]["bytes"], **{key: middle(of_form, key) for key in ("pointmap_error", "same_matches")})
        for name, of_form in rows.items()
    ]


def usable(scene: RegistrationScene) -> bool:
    """Whether a scene has robots to compare and one to learn from."""
    return bool(meetings(scene))
