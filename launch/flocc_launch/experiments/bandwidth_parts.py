"""The four measurements of the bandwidth experiment: each gives forms with their bytes and what is measured on them."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from flocc_agent.config import PerceptionConfig, SyntheticConfig
from flocc_launch.evaluate_registration import Outcome, cross_pairs, odometry_pair, outcome, recall_at_one
from flocc_launch.experiments.experiment import Row
from flocc_launch.experiments.keyed_engine import SIZES_PX, keyed_engine, keyed_pictures
from flocc_launch.experiments.reductions import Basis, keypoint_forms, latent_forms, reduced_descriptors
from flocc_launch.experiments.registration_data import RegistrationData, RegistrationSettings, distance_m, drawn_pairs
from flocc_launch.experiments.simulated import simulated
from flocc_launch.experiments.statistics import middle
from flocc_launch.registration_scenes import Scene
from flocc_launch.scenario import Scenario, TracksScenario

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


def learning_robot(scene: Scene) -> str:
    """The robot on whose views bases are learned, and which is not compared."""
    return min(view.robot for view in scene.views)


def compared(scene: Scene) -> list[int]:
    """Numbers of the views that are compared."""
    return [k for k, view in enumerate(scene.views) if view.robot != learning_robot(scene)]


def descriptor_forms(data: RegistrationData, name: str) -> list[Row]:
    """Recall@1 between the robots on whose descriptors nothing was learned."""
    scene, encoded = data.scenes[name], data.encoded[name]
    described = np.array([encoded.descriptor(k) for k in range(len(scene.views))])
    kept = compared(scene)
    basis = Basis.of(described[[k for k in range(len(scene.views)) if k not in set(kept)]])
    part = Scene(name, tuple(scene.views[k] for k in kept), *limits(scene))
    rows = []
    for form_name, (size, values) in reduced_descriptors(described[kept], basis).items():
        recall = recall_at_one(cross_pairs(part, values.astype(np.float32)), part)
        rows.append(form(form_name, size, recall_at_1=recall))
    return rows


def limits(scene: Scene) -> tuple[float, float, float]:
    """A scene's limits, to make a part of it."""
    return scene.place_distance_m, scene.place_angle_rad, scene.position_error_max_m


def keypoint_accuracy(data: RegistrationData, name: str, pairs: int, seed: int) -> list[Row]:
    """Right registrations of drawn pairs at one place, with every form of the match's latent."""
    from flocc_agent.perception.classical.encoder import decode_features, encode_features

    scene, encoded = data.scenes[name], data.encoded[name]
    kept = set(compared(scene))
    learned = [decode_features(encoded[k]).descriptors for k in range(len(scene.views)) if k not in kept]
    samples = np.concatenate(learned)
    basis = Basis.of(samples[:: max(1, len(samples) // DESCRIPTORS_LEARNED)])
    near = drawn_pairs(scene, distance_m(RegistrationSettings(), scene), len(scene.views) ** 2, seed)
    places = [pair for pair in (encoded.pair(i, j) for i, j in near if {i, j} <= kept) if pair.same_place]
    rng = np.random.default_rng(seed)
    drawn = [places[k] for k in sorted(rng.choice(len(places), min(pairs, len(places)), replace=False))]
    rows = []
    for form_name, reduce in keypoint_forms(basis).items():
        sizes, outcomes = [], []
        for pair in drawn:
            size, features = reduce(decode_features(encoded[pair.match]))
            match = encode_features(features, {})
            odometry = odometry_pair(scene, pair.query, encoded)
            outcomes.append(outcome(scene, pair, data.skills.register(encoded[pair.query], match, odometry)))
            sizes.append(size)
        rows.append(form(form_name, float(np.mean(sizes)), **accuracy(outcomes)))
    return rows


def accuracy(outcomes: Sequence[Outcome]) -> dict[str, float | None]:
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
    from flocc_agent.perception.mast3r.matching import MatchParameters
    from flocc_agent.perception.mast3r.pair import match_pair
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


def usable(scene: Scene) -> bool:
    """Whether a scene is passes of at least three robots: one to learn from, two to compare."""
    robots = [view.robot for view in scene.views]
    return sum(robots.count(robot) >= VIEWS_MIN for robot in sorted(set(robots))) >= 3
