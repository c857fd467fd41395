"""Faults on demand: what an operator orders of a running agent, and what it does to the agent's links and workers.

Only agents whose configuration says `transport.chaos` take orders, and with TLS only from certificates of operators.
"""

import math
from dataclasses import replace
from typing import Literal, assert_never

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from flocc_agent.radio import Blackout, RadioParameters
from flocc_protocol.errors import FloccError

ROBOTS_MAX = 1000
SLOW_MIN, SLOW_MAX = 1.0, 1000.0
"""Bounds of a robot's slowness; work that lasts longer would outlast every deadline, and the end of the order."""
NEEDS_VALUE = frozenset({"loss", "latency", "range", "slow"})


class BadOrder(FloccError):
    """An order that means nothing; the message says why."""


class Order(BaseModel):
    """One order, as it travels (JSON)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["partition", "blackout", "heal", "calm", "loss", "latency", "range", "slow", "kill"]
    """What happens; heal ends partitions and blackouts, calm all there is to the links."""
    robots: tuple[str, ...] = Field((), max_length=ROBOTS_MAX)
    """Whom it concerns: blackout, slow, kill."""
    groups: tuple[tuple[str, ...], ...] = Field((), max_length=ROBOTS_MAX)
    """Groups of a partition; robots that no group names are one more group."""
    value: float | None = Field(None, ge=0, allow_inf_nan=False)
    """Loss ratio, latency in seconds, range in metres, or the factor by which robots are slow."""

    @model_validator(mode="after")
    def _is_complete(self) -> "Order":
        if self.kind in NEEDS_VALUE and self.value is None:
            raise ValueError(f"'{self.kind}' needs a value")
        if self.kind == "loss" and self.value is not None and self.value > 1.0:
            raise ValueError("a loss is between 0 and 1")
        if self.kind == "slow" and self.value is not None and not SLOW_MIN <= self.value <= SLOW_MAX:
            raise ValueError(f"'slow' takes a factor from {SLOW_MIN:g} to {SLOW_MAX:g}, not {self.value:g}")
        if self.kind == "partition" and not self.groups:
            raise ValueError("a partition names its groups")
        if self.kind in ("blackout", "slow", "kill") and not self.robots:
            raise ValueError(f"'{self.kind}' names its robots")
        return self

    def concerns(self, robot: str) -> bool:
        """Whether a robot has to do something."""
        return not self.robots or robot in self.robots or self.kind == "blackout"


def read_order(request: bytes) -> Order:
    """Read an order.

    Raises:
        BadOrder: It is not one.
    """
    try:
        return Order.model_validate_json(request)
    except ValidationError as error:
        raise BadOrder(error.errors()[0]["msg"]) from error


def disturbed(parameters: RadioParameters, order: Order, now_s: float) -> RadioParameters:
    """Give the links after an order; those that concern no link stay as they are."""
    value = math.inf if order.value is None else order.value
    match order.kind:
        case "partition":
            return parameters.partitioned(order.groups, now_s)
        case "blackout":
            return replace(parameters, blackouts=(*parameters.blackouts, Blackout(order.robots, now_s)))
        case "loss":
            return replace(parameters, link=replace(parameters.link, loss_ratio=value))
        case "latency":
            return replace(parameters, link=replace(parameters.link, latency_s=value))
        case "range":
            return replace(parameters, range_m=value if value > 0.0 else None)
        case "heal":
            return parameters.healed()
        case "calm":
            return RadioParameters()
        case "slow" | "kill":
            return parameters
        case _:
            assert_never(order.kind)
