"""The paper's claims on formulations and solvers, judged alike on pose graphs and on whole swarms."""

from collections.abc import Mapping
from dataclasses import dataclass

from flocc_agent.config import Formulation, Solver
from flocc_lab.experiments.experiment import ExperimentFinding, judged

SAME_RATIO = 1.05
"""Errors nearer to each other than this are the same: one draw more would turn them around."""
LITTLE_RATIO = 1.1
FAR_MORE_RATIO = 2.0
FREE = (Formulation.INDEPENDENT.value, Formulation.SMOOTHED.value)
COMPARED = (Formulation.BASE.value, *FREE)


@dataclass(frozen=True, slots=True)
class MeasuredClaim:
    """One formulation with one solver.

    Attributes:
        ate_m: Joint ATE.
        solve_cpu_s: CPU time of a solve.
    """

    ate_m: float
    solve_cpu_s: float


def formulation_findings(
    where: str, of: Mapping[tuple[str, str], MeasuredClaim], odometry_m: float | None = None
) -> list[ExperimentFinding]:
    """What the paper says of free scales and of GNC, as far as it was measured.

    Args:
        where: Data, for the claim.
        of: What was measured, by (formulation, solver).
        odometry_m: Joint ATE of odometry alone; what is worse shows nothing.
    """
    found = []
    for solver in (Solver.LM.value, Solver.GNC_TLS.value):
        if all((name, solver) in of for name in COMPARED):
            ate_m = {name: of[name, solver].ate_m for name in COMPARED}
            found.append(_free_beat_base(f"with {solver} ({where})", ate_m, odometry_m))
    plain, robust = (of.get((Formulation.SMOOTHED.value, solver.value)) for solver in (Solver.LM, Solver.GNC_TLS))
    if plain is not None and robust is not None:
        found += [_adds_little(where, plain, robust, odometry_m), _costs_far_more(where, plain, robust)]
    return found


def _free_beat_base(how: str, ate_m: Mapping[str, float], odometry_m: float | None) -> ExperimentFinding:
    numbers = ", ".join(f"{name} {value:.3g} m" for name, value in ate_m.items())
    holds: bool | None = max(ate_m[name] for name in FREE) < ate_m[Formulation.BASE.value]
    if odometry_m is not None and min(ate_m.values()) > odometry_m:
        holds, numbers = None, f"{numbers}; all are worse than odometry alone, {odometry_m:.3g} m"
    elif max(ate_m.values()) <= SAME_RATIO * min(ate_m.values()):
        holds, numbers = None, f"{numbers}; these are the same"
    return judged(f"Independent and smoothed scales beat base {how}", "Sec. IV-C", holds, f"{numbers}.")


def _adds_little(
    where: str, plain: MeasuredClaim, robust: MeasuredClaim, odometry_m: float | None
) -> ExperimentFinding:
    lost = odometry_m is not None and min(plain.ate_m, robust.ate_m) > odometry_m
    holds = None if lost else plain.ate_m <= LITTLE_RATIO * robust.ate_m
    numbers = f"LM {plain.ate_m:.3g} m, GNC {robust.ate_m:.3g} m."
    return judged(f"GNC adds little to smoothed scales ({where})", "Sec. IV-C", holds, numbers)


def _costs_far_more(where: str, plain: MeasuredClaim, robust: MeasuredClaim) -> ExperimentFinding:
    numbers = f"LM {plain.solve_cpu_s:.2g} s, GNC {robust.solve_cpu_s:.2g} s of CPU."
    holds = robust.solve_cpu_s > FAR_MORE_RATIO * plain.solve_cpu_s
    return judged(f"GNC costs far more than LM with smoothed scales ({where})", "Sec. IV-C", holds, numbers)
