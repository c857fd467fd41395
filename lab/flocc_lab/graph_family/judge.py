"""How far an answer is from the truth and from the oracle, and whether it counts as a failure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import umeyama
from flocc_lab.graph_family.graphs import KnownGraph
from flocc_lab.graph_family.methods import MethodAnswer
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

FAILED_RATIO, FAILED_M = 2.0, 0.5
ORACLE_LEAST_M = 0.05
WORSE_RATIO, WORSE_M = 1.1, 0.1


@dataclass(frozen=True, slots=True)
class GraphVerdict:
    """One answer, judged.

    Attributes:
        seed: The member of the family.
        method: Name of the method.
        ate_m: Joint ATE of the logs that the oracle joins; over several components, the mean square of all.
        oracle_m: The same of the oracle.
        joined: Whether all logs share a frame that share one in the oracle's answer.
        wrong_kept: Wrong closures that are used.
        right_lost: Right closures that are not used.
        right: Right closures.
        worse_than_odometry: Whether the robots' own ways are worse than before, where the oracle's are not.
        warned: Whether anything was said.
        groups: Groups of wrong closures that agree with each other.
        cpu_s: CPU time.
        lost: Why there is no answer, else empty.
    """

    seed: int
    method: str
    ate_m: float
    oracle_m: float
    joined: bool
    wrong_kept: int
    right_lost: int
    right: int
    worse_than_odometry: bool
    warned: bool
    groups: int
    cpu_s: float
    lost: str = ""

    @property
    def ratio(self) -> float:
        """ATE over the oracle's; below five centimetres nothing counts."""
        return max(self.ate_m, ORACLE_LEAST_M) / max(self.oracle_m, ORACLE_LEAST_M)

    @property
    def failed(self) -> bool:
        """Over twice the oracle and over half a metre, or worse than odometry, or no answer."""
        far = self.ratio > FAILED_RATIO and self.ate_m > FAILED_M
        return far or self.worse_than_odometry or bool(self.lost)


def judged(member: KnownGraph, method: str, answer: MethodAnswer, oracle: MethodAnswer) -> GraphVerdict:
    """Compare an answer with the truth, and that with the oracle's."""
    own, own_oracle, own_odometry = (own_ate_m(member, T) for T in (answer.T_map_keyframe, oracle.T_map_keyframe, None))
    limit_m = max(WORSE_RATIO * own_odometry, own_odometry + WORSE_M)
    frame = {log: n for n, logs in enumerate(answer.groups) for log in logs}
    return GraphVerdict(
        seed=member.seed,
        method=method,
        ate_m=joint_ate_m(member, answer, oracle.groups),
        oracle_m=joint_ate_m(member, oracle, oracle.groups),
        joined=all(len({frame[log] for log in logs}) == 1 for logs in oracle.groups),
        wrong_kept=int(np.count_nonzero(answer.used & ~member.is_right)),
        right_lost=int(np.count_nonzero(~answer.used & member.is_right)),
        right=int(np.count_nonzero(member.is_right)),
        worse_than_odometry=own > limit_m and own_oracle <= limit_m,
        warned=bool(answer.warnings),
        groups=member.groups,
        cpu_s=answer.cpu_s,
    )


def joint_ate_m(member: KnownGraph, answer: MethodAnswer, groups: Iterable[tuple[LogId, ...]]) -> float:
    """Root mean square of the positions' errors, each group of logs aligned as one."""
    return _rmse(np.concatenate([_errors_m(member, answer.T_map_keyframe, logs) for logs in groups]))


def own_ate_m(member: KnownGraph, T: Mapping[LogId, Float] | None) -> float:
    """The same with each robot aligned on its own; of odometry where no poses are given."""
    poses = T or {log: t.T_odom_keyframe for log, t in member.graph.trajectories.items()}
    return _rmse(np.concatenate([_errors_m(member, poses, (log,)) for log in poses]))


def _errors_m(member: KnownGraph, T: Mapping[LogId, Float], logs: Iterable[LogId]) -> Float:
    names = list(logs)
    source = np.concatenate([T[log][:, :3, 3] for log in names])
    target = np.concatenate([member.T_world_keyframe[log][:, :3, 3] for log in names])
    _, T_align = umeyama(source, target)
    return np.asarray(np.linalg.norm(source @ T_align[:3, :3].T + T_align[:3, 3] - target, axis=1))


def _rmse(errors: Float) -> float:
    return float(np.sqrt(np.mean(errors**2)))
