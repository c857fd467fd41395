"""Who may write what: TLS settings and access rules for zenoh, and Ed25519 signatures over records.

TLS names the last hop only; records travel through relays, so each carries a signature by the robot that wrote it.
`cryptography` is imported where it is used: installations that trust their network need not have it.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from flocc_agent.config import TlsConfig
from flocc_agent.runtime.transport import TransportError
from flocc_protocol import keys

WRITES = ["put", "delete", "liveliness_token", "declare_queryable", "reply"]
READS = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]


def tls_settings(tls: TlsConfig) -> dict[str, Any]:
    """Give zenoh's settings for mutual TLS, and nothing but TLS.

    Raises:
        TransportError: A file is missing or unreadable; the message names it.
    """
    for path in (tls.ca, tls.certificate, tls.key):
        check_readable(path)
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls/root_ca_certificate": str(tls.ca),
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/listen_private_key": str(tls.key),
        "transport/link/tls/listen_certificate": str(tls.certificate),
        "transport/link/tls/connect_private_key": str(tls.key),
        "transport/link/tls/connect_certificate": str(tls.certificate),
        "transport/link/tls/verify_name_on_connect": tls.names_verified,
    }


def check_readable(path: Path) -> None:
    """Raise a TransportError that names the file, if it cannot be read."""
    try:
        path.read_bytes()
    except OSError as error:
        raise TransportError(f"{path}: cannot be read: {error.strerror}") from error


def access_control(swarm: str, members: Iterable[str], operators: Iterable[str]) -> dict[str, Any]:
    """Give zenoh's access rules: everybody certified reads the swarm, each robot writes under its own name only.

    Rules apply to what comes in, by the common name of the link's certificate; what is not allowed is dropped.
    """
    everything = f"{keys.ROOT}/{keys.VERSION}/{swarm}/**"
    latents = f"{keys.ROOT}/{keys.VERSION}/{swarm}/*/{keys.LATENT}/**"
    admin = [keys.admin_key(swarm, "*", each) for each in keys.Admin]
    members, operators = sorted(set(members)), sorted(set(operators))
    own = [_rule(f"write-{name}", WRITES, [f"{keys.robot_prefix(swarm, name)}/**"], ["ingress"]) for name in members]
    rules = [
        _rule("read", READS, [everything, keys.presence_pattern()], ["ingress"]),
        _rule("fetch", ["query"], [latents], ["ingress"]),
        _rule("send", [*WRITES, *READS, "query"], ["**"], ["egress"]),
        _rule("operate", ["query"], admin, ["ingress"]),
        *own,
    ]
    everybody = [*members, *(name for name in operators if name not in members)]
    subjects = [{"id": name, "cert_common_names": [name]} for name in everybody]
    policies: list[dict[str, Any]] = [{"rules": ["read", "fetch", "send"], "subjects": everybody}]
    policies += [{"rules": [f"write-{name}"], "subjects": [name]} for name in members]
    if operators:
        policies.append({"rules": ["operate"], "subjects": operators})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, messages: list[str], key_exprs: list[str], flows: list[str]) -> dict[str, Any]:
    return {"id": name, "messages": messages, "flows": flows, "permission": "allow", "key_exprs": key_exprs}
