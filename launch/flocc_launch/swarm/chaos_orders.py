"""`flocc chaos`: faults on demand in a running swarm, in words.

`partition r1,r2 | r3`, `blackout r2`, `heal` (both), `kill r2`, `loss 0.3`, `latency 0.1`, `range 20`, `slow r1 10x`,
`calm` (perfect links again).
"""

import asyncio

from pydantic import ValidationError

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.chaos import Order
from flocc_protocol.errors import FloccError

USAGE = "partition r1,r2 | r3 ; blackout r2 ; heal ; calm ; kill r2 ; loss 0.3 ; latency 0.1 ; range 20 ; slow r1 10x"


class ChaosError(FloccError):
    """An order that cannot be read, or that nobody took."""


def parse_order(text: str) -> Order:
    """Read an order in words.

    Raises:
        ChaosError: The words are no order.
    """
    kind, _, rest = text.strip().partition(" ")
    words = rest.replace(",", " ").split()
    fields: dict[str, object] = {"kind": kind}
    match kind:
        case "partition":
            fields["groups"] = [group.replace(",", " ").split() for group in rest.split("|") if group.strip()]
        case "blackout" | "kill":
            fields["robots"] = words
        case "loss" | "latency" | "range":
            fields["value"] = _number(words[-1] if len(words) == 1 else "", text)
        case "slow":
            fields |= {"robots": words[:-1], "value": _number(words[-1].removesuffix("x") if words else "", text)}
        case "heal" | "calm" if not words:
            pass
        case _:
            raise ChaosError(f"{text!r} is no order; one of: {USAGE}")
    try:
        return Order.model_validate(fields)
    except ValidationError as error:
        raise ChaosError(f"{text!r}: {error.errors()[0]['msg']}") from error


def _number(word: str, text: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ChaosError(f"{text!r} needs one number; one of: {USAGE}") from None


def disturb(config: TransportConfig, swarm: str, order: Order, timeout_s: float = 3.0) -> dict[str, str]:
    """Give an order to every agent in reach, and collect what each says.

    Raises:
        ChaosError: Nobody answered.
        TransportError: The network cannot be used as configured.
    """
    from flocc_agent.runtime.network_faults import with_faults
    from flocc_agent.runtime.zenoh_admin import ask
    from flocc_protocol.keys import Admin

    request = order.model_dump_json(exclude_defaults=True).encode()
    answers = asyncio.run(ask(config, swarm, Admin.CHAOS, request, timeout_s=timeout_s))
    if not answers:
        nobody = f"swarm {swarm}: no agent took the order; only agents with transport.chaos = true do"
        raise ChaosError(with_faults(nobody, config))
    return {robot: answer.decode(errors="replace")[:200] for robot, answer in answers.items()}
