"""`flocc experiment registration`: which number tells right registrations from wrong ones (Sec. IV-B).

Pairs of views of different robots that are nearer than a distance are drawn, as in the paper, whatever they look at,
and registered. A registration is an outlier when its translation error, with the true length, exceeds a limit. Pairs
for which the method gives no pose are counted and belong to neither side: nothing could accept them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from flocc_lab.bench.perception_quality import PairOutcome, registered
from flocc_lab.experiments.experiment import Cell, Experiment, Row, Summary
from flocc_lab.experiments.logistic import LogisticFit, fit_logistic
from flocc_lab.experiments.plots import COLOURS
from flocc_lab.experiments.precision_recall import Curve, curve
from flocc_lab.experiments.registration_data import (
    RegistrationSettings,
    data_of,
    distance_m,
    drawn_pairs,
    error_max_m,
    near_pairs,
    prepare_data,
)
from flocc_lab.experiments.registration_findings import POOLED, findings, halved

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METRICS = {
    "similarity": "similarity",
    "confidence": "mean confidence",
    "confidence_ratio": "confidence ratio",
    "correspondences": "correspondences",
    "ratio": "correspondence ratio, Eq. (1)",
}


def cells(settings: RegistrationSettings) -> list[Cell]:
    """Portions of each scene's pairs."""
    portions = []
    for name, scene in data_of(settings).scenes.items():
        count = min(len(near_pairs(scene, distance_m(settings, scene))), settings.pairs_max)
        starts = range(0, count, settings.pairs_per_cell)
        portions += [Cell({"scene": name, "first": start}) for start in starts]
    return portions


def measure(settings: RegistrationSettings, cell: Cell, seed: int) -> Row:
    """Register one portion of a scene's pairs."""
    data, name, first = data_of(settings), cell.parameters["scene"], cell.parameters["first"]
    scene, encoded = data.scenes[name], data.encoded[name]
    drawn = drawn_pairs(scene, distance_m(settings, scene), settings.pairs_max, seed)
    pairs = [encoded.pair(i, j) for i, j in drawn[first : first + settings.pairs_per_cell]]
    limited = replace(scene, position_error_max_m=error_max_m(settings, scene))
    outcomes, register_s = registered(limited, pairs, encoded, data.skills)
    return {
        "distance_m": distance_m(settings, scene),
        "error_max_m": error_max_m(settings, scene),
        "register_s": register_s,
        "outcomes": [outcome_row(outcome, limited.position_error_max_m) for outcome in outcomes],
    }


def outcome_row(outcome: PairOutcome, limit_m: float) -> Row:
    """What is kept of one pair."""
    error_m = outcome.position_error_m
    return {
        "query": outcome.query,
        "match": outcome.match,
        **{name: getattr(outcome, name) for name in METRICS},
        "failure": outcome.failure,
        "rotation_error_deg": outcome.rotation_error_deg,
        "position_error_m": error_m,
        "inlier": None if error_m is None else error_m <= limit_m,
    }


def pairs_of(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """All pairs by scene, and pooled where there are several scenes."""
    scenes: dict[str, list[Row]] = {}
    for row in rows:
        scenes.setdefault(row["scene"], []).extend(row["outcomes"])
    return scenes if len(scenes) < 2 else {**scenes, POOLED: [pair for pairs in scenes.values() for pair in pairs]}


def curves_of(pairs: Sequence[Row]) -> dict[str, Curve]:
    """Curves of the metrics that the method gives, over the pairs with a pose."""
    posed = [pair for pair in pairs if pair["inlier"] is not None]
    found = {}
    for metric in METRICS:
        scores = [pair[metric] for pair in posed]
        if None not in scores and (drawn := curve(scores, [pair["inlier"] for pair in posed])) is not None:
            found[metric] = drawn
    return found


def summarise(_settings: RegistrationSettings, rows: Sequence[Row]) -> Summary:
    """A row per scene and metric that the method gives."""
    scenes = pairs_of(rows)
    curves = {name: curves_of(pairs) for name, pairs in scenes.items()}
    given = [metric for metric in METRICS if any(metric in found for found in curves.values())] or ["ratio"]
    table = [
        metric_row(name, pairs, metric, curves[name].get(metric)) for name, pairs in scenes.items() for metric in given
    ]
    return Summary(table, findings(scenes, curves), [*notes(scenes, rows), *fit_notes(fit_of(rows))])


def metric_row(scene: str, pairs: Sequence[Row], metric: str, found: Curve | None) -> Row:
    """Areas and best thresholds of one metric."""
    row = {
        "scene": scene,
        "metric": METRICS[metric],
        "pairs": len(pairs),
        "with_pose": sum(pair["inlier"] is not None for pair in pairs),
        "inliers": sum(pair["inlier"] is True for pair in pairs),
    }
    best = None if found is None else found.best()
    sure = None if found is None else found.first_with_precision(halved(found))
    values: dict[str, float | None] = dict.fromkeys(
        ("average_precision", "roc_auc", "best_threshold", "precision", "recall", "threshold_half", "recall_half")
    )
    if found is not None and best is not None:
        values |= {
            "average_precision": found.average_precision,
            "roc_auc": found.roc_auc,
            "best_threshold": float(found.thresholds[best]),
            "precision": float(found.precision[best]),
            "recall": float(found.recall[best]),
        }
    if found is not None and sure is not None:
        values |= {"threshold_half": float(found.thresholds[sure]), "recall_half": float(found.recall[sure])}
    return {**row, **values}


def notes(scenes: Mapping[str, Sequence[Row]], rows: Sequence[Row]) -> list[str]:
    """What the table leaves out."""
    limits = {row["scene"]: (row["distance_m"], row["error_max_m"]) for row in rows}
    said = [
        f"{name}: pairs within {limits[name][0]:g} m, outliers beyond {limits[name][1]:g} m."
        for name in scenes
        if name in limits
    ]
    said.append(
        "Pairs nearer than half the limit cannot be outliers by the paper's rule, whatever direction is found; average "
        "precision of a metric without meaning is the share of inliers among pairs with a pose. best_threshold has the "
        "largest F1; threshold_half is the lowest at which the share of outliers is half of what it is without any."
    )
    posed = [pair for pairs in scenes.values() for pair in pairs if pair["inlier"] is not None]
    if not posed:
        said.append("No pair has a pose, so nothing can be judged; keyed random weights of MASt3R recognise nothing.")
    elif all(pair["confidence"] is None for pair in posed):
        said.append("Mean confidence and its ratio are n/a: only MASt3R gives confidences, and this method is another.")
    return said


def fit_of(rows: Iterable[Row]) -> LogisticFit | None:
    """Eq. (2) fitted to all pairs with a pose and a ratio."""
    posed = [pair for row in rows for pair in row["outcomes"] if pair["inlier"] is not None]
    return fit_logistic([pair["ratio"] for pair in posed], [pair["inlier"] for pair in posed])


def fit_notes(fit: LogisticFit | None) -> list[str]:
    """What learning Eq. (2)'s k from the pairs gives."""
    if fit is None:
        return ["Eq. (2) cannot be fitted: there are no inliers, or no outliers."]
    free = (
        f"with a free midpoint k = {fit.free_steepness:.3g} around a ratio of "
        f"{'n/a' if fit.free_midpoint is None else f'{fit.free_midpoint:.3g}'} (log loss {fit.free_log_loss:.3f})"
    )
    if fit.steepness is None:
        return [
            f"Eq. (2) has no k > 0 for these {fit.pairs} registrations: most inliers have a ratio below 1, where "
            f"Eq. (2) gives less than one half for every k; {free}."
        ]
    return [
        f"Eq. (2) fitted to {fit.pairs} registrations: k = {fit.steepness:.3g} (log loss {fit.log_loss:.3f}); {free}."
    ]


def draw(figure: "Figure", _settings: RegistrationSettings, rows: Sequence[Row]) -> None:
    """Precision over recall, a panel per scene."""
    scenes = {name: curves for name, pairs in pairs_of(rows).items() if (curves := curves_of(pairs))}
    columns = min(max(len(scenes), 1), 3)
    lines = -(-max(len(scenes), 1) // columns)
    figure.set_size_inches(4.2 * columns, 3.9 * lines)
    panels = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat
    for (name, curves), panel in zip(scenes.items(), panels, strict=False):
        for k, (metric, label) in enumerate(METRICS.items()):
            if metric in curves:
                found = curves[metric]
                text = f"{label} ({found.average_precision:.3f})"
                panel.plot(found.recall, found.precision, color=COLOURS[k], label=text)
        share = next(iter(curves.values())).right_share
        panel.axhline(share, color="#888888", linestyle=":", label=f"all accepted ({share:.2f})")
        panel.set_title(name)
        panel.set_xlabel("recall")
        panel.legend(loc="lower left", fontsize=7, title="average precision", title_fontsize=7)
    for panel in list(panels):
        panel.set_visible(False)
    figure.axes[0].set_ylabel("precision")
    lowest = min((float(c.precision.min()) for curves in scenes.values() for c in curves.values()), default=0.0)
    figure.axes[0].set(xlim=(0, 1.02), ylim=(max(lowest - 0.15, 0.0), 1.005))


REGISTRATION = Experiment(
    name="registration",
    title="precision and recall of the numbers that could accept a registration, and the fit of Eq. (2)",
    settings=RegistrationSettings,
    quick={
        "worlds": (),
        "walks": (3,),
        "perception": {"method": "synthetic"},
        "pairs_max": 100,
        "pairs_per_cell": 50,
    },
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare_data,
)
