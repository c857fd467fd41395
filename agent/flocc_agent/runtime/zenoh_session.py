"""zenoh sessions as flocc needs them: peer mode, no shared memory, explicit endpoints beside scouting.

Each choice was measured with zenoh 1.10.2: two sessions per agent (control, bulk) because bulk on a shared link
delays heartbeats; one link per pair (max_links 1, the higher name dials); short open_timeout because attempts that
hang keep pairs apart under loss; shared memory off because it bypasses emulated links. What RUNTIME and
BULK_LEASE_FACTOR save is in docs/reliability.md.
"""

import json
import os
import re
from enum import Enum
from typing import Any

import zenoh

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.linger import keep_lingers_off
from flocc_agent.runtime.security import secure_settings
from flocc_agent.runtime.transport import TransportError

RX_MESSAGE_MARGIN_BYTES = 64 * 1024
BULK_LEASE_FACTOR = 4
"""Bulk links are idle most of the time, and each sends four signs of life per lease: with 30 robots that is as many
messages as their heartbeats. Control links are never idle."""
OPEN_TIMEOUT_S = 2.0
"""Time for one attempt to open a link; a longer one leaves pairs apart for longer under heavy loss."""
RETRY_MAX_S = 1.0
"""Longest pause between two attempts to dial a robot of the roster: robots meet for seconds."""
RUNTIME = "(rx: (worker_threads: 1), tx: (handover: rx), net: (handover: rx), acc: (handover: rx))"
"""One thread for all that zenoh does on links: waking six for small messages costs a quarter more. Nothing may hold
it up, hence `linger`."""


class Plane(Enum):
    """Which of the two sessions of an agent."""

    CONTROL = "control"
    BULK = "bulk"


def session_settings(
    config: TransportConfig, swarm: str, robot: str, plane: Plane, dials_all: bool = False
) -> dict[str, Any]:
    """Give zenoh's settings, by zenoh's path, for one session of one robot.

    Robots with a higher name dial those with a lower one, so that each pair has one link. An operator dials all, also
    those that scouting finds: he does not listen, so that nobody could dial him.
    """
    control = plane is Plane.CONTROL
    dialled = [
        endpoint
        for name, peer in sorted(config.roster.items())
        if name < robot or dials_all
        for endpoint in (peer.control if control else peer.bulk)
    ]
    strategy = {"peer": {"to_router": "always", "to_peer": "always" if dials_all else "greater-zid"}}
    message_bytes_max = config.message_bytes_max if control else config.chunk_bytes
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": list(config.control_listen if control else config.bulk_listen),
        "connect/endpoints": dialled,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": round(RETRY_MAX_S * 1000),
            "period_increase_factor": 1.5,
        },
        "scouting/multicast/enabled": config.scouts(swarm),
        "scouting/multicast/address": config.multicast_group(control),
        "scouting/multicast/interface": config.interface,
        "scouting/multicast/autoconnect_strategy": strategy,
        "scouting/gossip/enabled": config.gossip,
        "scouting/gossip/autoconnect_strategy": strategy,
        "adminspace/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_links": 1,
        "transport/unicast/open_timeout": round(OPEN_TIMEOUT_S * 1000),
        "transport/unicast/accept_timeout": round(OPEN_TIMEOUT_S * 1000),
        "transport/link/tx/lease": round(config.lease_s * 1000) * (1 if control else BULK_LEASE_FACTOR),
        "transport/link/rx/max_message_size": message_bytes_max + RX_MESSAGE_MARGIN_BYTES,
    }
    if not control:
        settings["transport/link/tcp/so_sndbuf"] = config.bulk_send_buffer_bytes
    if config.tls is not None:
        settings |= secure_settings(config.tls, swarm, robot)
    return settings


def open_session(settings: dict[str, Any], whose: str) -> zenoh.Session:
    """Open a session; blocks for up to half a second.

    Raises:
        TransportError: A setting that zenoh refuses, a port in use, an address that is not this machine's.
    """
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)  # read when the process opens its first session
    zenoh.init_log_from_env_or("off")
    keep_lingers_off()
    zenoh_config = zenoh.Config()
    for path, value in settings.items():
        try:
            zenoh_config.insert_json5(path, json.dumps(value))
        except zenoh.ZError as error:
            raise TransportError(f"{whose}: zenoh refuses the setting {path} = {value!r}") from error
    try:
        return zenoh.open(zenoh_config)
    except zenoh.ZError as error:
        cause = first_cause(str(error), settings.get("listen/endpoints", []))
        raise TransportError(f"{whose}: {cause}") from error


def first_cause(text: str, listened: list[str]) -> str:
    """Reduce zenoh's chain of causes to one sentence without source paths; it names where was to be listened."""
    if locator := re.search(r"\[?(\S+): Address already in use", text):
        return f"the address {locator[1].lstrip('[')} is in use by another process"
    if locator := re.search(r"\[?(\S+): Cannot assign requested address", text):
        return f"the address {locator[1].lstrip('[')} is not one of this machine"
    if "lookup address" in text:
        return f"the host of {' or '.join(listened)} is not known"
    return f"zenoh cannot listen on {' or '.join(listened)}: " + re.sub(r"\s+at /\S+", "", text).rstrip(". ")
