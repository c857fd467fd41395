"""The paper's claims on the numbers that could accept a registration, held against their curves."""

from collections.abc import Mapping, Sequence

import numpy as np

from flocc_lab.experiments.experiment import ExperimentFinding, Row, judged
from flocc_lab.experiments.precision_recall import Curve, curve

POOLED = "all"
"""Name of all scenes together."""
RESAMPLES = 500
SOURCE = "Sec. IV-B, precision and recall of five metrics"


def findings(scenes: Mapping[str, Sequence[Row]], curves: Mapping[str, Mapping[str, Curve]]) -> list[ExperimentFinding]:
    """The paper's claims on the metrics."""
    name = POOLED if POOLED in curves else next(iter(curves))
    whole = curves[name]
    if "ratio" not in whole:
        return [judged("The correspondence ratio beats similarity", SOURCE, None, "No scene has inliers and outliers.")]
    single = {name: found for name, found in curves.items() if name != POOLED and "ratio" in found}
    return [_ratio_beats_similarity(scenes[name], whole, single), _similarity_alone(whole), _unitless(single)]


def _ratio_beats_similarity(
    pairs: Sequence[Row], whole: Mapping[str, Curve], single: Mapping[str, Mapping[str, Curve]]
) -> ExperimentFinding:
    """Decided by the average precision over all pairs, where its difference is not a matter of which pairs came."""
    ratio, similarity = whole["ratio"], whole["similarity"]
    low, high = resampled_difference(pairs, "ratio", "similarity")
    better = [name for name, c in single.items() if c["ratio"].average_precision > c["similarity"].average_precision]
    numbers = (
        f"Average precision {ratio.average_precision:.3f} against {similarity.average_precision:.3f} over all pairs "
        f"with a pose (95 % of resampled differences lie between {low:+.3f} and {high:+.3f}), ROC {ratio.roc_auc:.3f} "
        f"against {similarity.roc_auc:.3f}; {ratio.right_share:.1%} of them are inliers. The count of "
        f"correspondences has {whole['correspondences'].average_precision:.3f}. The ratio is better in {len(better)} "
        f"of {len(single)} scenes ({', '.join(better) or 'none'})."
    )
    holds = None if low <= 0.0 <= high else low > 0.0
    return judged("The correspondence ratio beats similarity", SOURCE, holds, numbers)


def resampled_difference(pairs: Sequence[Row], one: str, other: str) -> tuple[float, float]:
    """Range of 95 % of the differences in average precision when pairs are drawn anew with replacement."""
    posed = [pair for pair in pairs if pair["inlier"] is not None]
    right = np.array([pair["inlier"] for pair in posed])
    scores = [np.array([pair[metric] for pair in posed], dtype=np.float64) for metric in (one, other)]
    rng = np.random.default_rng(0)
    differences = []
    for _ in range(RESAMPLES):
        drawn = rng.integers(len(posed), size=len(posed))
        curves = [curve(score[drawn], right[drawn]) for score in scores]
        if curves[0] is not None and curves[1] is not None:
            differences.append(curves[0].average_precision - curves[1].average_precision)
    low, high = np.quantile(differences, (0.025, 0.975)) if differences else (-1.0, 1.0)
    return float(low), float(high)


def halved(found: Curve) -> float:
    """The precision at which half as large a share of the accepted is wrong as when all are accepted."""
    return 1.0 - 0.5 * (1.0 - found.right_share)


def _similarity_alone(whole: Mapping[str, Curve]) -> ExperimentFinding:
    kept = {metric: _recall_when_halved(whole[metric]) for metric in ("similarity", "ratio")}
    numbers = (
        f"All accepted, {1.0 - whole['ratio'].right_share:.1%} are outliers; a threshold that halves this share keeps "
        f"{kept['similarity']:.1%} of the inliers by similarity and {kept['ratio']:.1%} by the ratio."
    )
    holds = kept["similarity"] < 0.5 and kept["similarity"] < kept["ratio"]
    return judged("Similarity alone does not tell outliers (it loses half of the inliers)", SOURCE, holds, numbers)


def _recall_when_halved(found: Curve) -> float:
    k = found.first_with_precision(halved(found))
    return 0.0 if k is None else float(found.recall[k])


def _unitless(single: Mapping[str, Mapping[str, Curve]]) -> ExperimentFinding:
    """Whether the scenes want thresholds that differ less for the ratio than for the count."""
    wanted: dict[str, dict[str, float]] = {"ratio": {}, "correspondences": {}}
    for metric, values in wanted.items():
        for name, found in single.items():
            if (k := found[metric].first_with_precision(halved(found[metric]))) is not None:
                values[name] = float(found[metric].thresholds[k])
    claim = "The ratio is easier to tune than the count, because it has no unit"
    if any(len(values) < 2 for values in wanted.values()):
        return judged(claim, SOURCE, None, "Fewer than two scenes have outliers that a threshold halves.")
    spreads = {metric: max(values.values()) / min(values.values()) for metric, values in wanted.items()}
    shown = {
        metric: ", ".join(f"{name} {value:.3g}" for name, value in values.items()) for metric, values in wanted.items()
    }
    numbers = (
        f"The thresholds that halve each scene's outliers differ by a factor of {spreads['ratio']:.2g} for the ratio "
        f"({shown['ratio']}) and of {spreads['correspondences']:.2g} for the count ({shown['correspondences']})."
    )
    return judged(claim, SOURCE, spreads["ratio"] < spreads["correspondences"], numbers)
