"""Who may write what: TLS settings and access rules for zenoh, and Ed25519 signatures over records.

TLS proves who the next hop is; records travel through relays, so each carries a signature of the robot that wrote it.
`cryptography` is imported where it is used: installations that trust their network need not have it.
"""

import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flocc_agent.config import TlsConfig
from flocc_agent.core.claims import Claim, RecordClaim
from flocc_agent.core.pulls import remember
from flocc_agent.extras import to_install
from flocc_agent.runtime.transport import TransportError
from flocc_protocol import keys
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import NAME_PATTERN, LogId

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

CA, CERTIFICATE, KEY, SIGNING_KEY, MEMBERS = "ca.crt", "robot.crt", "robot.key", "signing.key", "members.json"
SIGNATURE_BYTES = 64
MEMBERS_MAX = 1000
VERDICTS_MAX = 4096
"""Signatures whose check is remembered until the robot asks for it: more than four messages can hold."""

WRITES = ["put", "delete", "liveliness_token", "declare_queryable", "reply"]
READS = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]


@dataclass(frozen=True, slots=True)
class Members:
    """Who belongs to a swarm.

    Attributes:
        swarm: Name of the swarm.
        robots: Public signing key (32 bytes) by robot; each writes under its own name only.
        operators: Names of certificates that may ask for status and inject faults.
        compute_classes: Compute class by robot, 0 for those that are not named; None: robots say so themselves.
    """

    swarm: str
    robots: Mapping[str, bytes]
    operators: tuple[str, ...]
    compute_classes: Mapping[str, int] | None = None


def read_members(path: Path) -> Members:
    """Read what `flocc keys` wrote.

    Raises:
        TransportError: The file is missing or not such a file; the message names it.
    """
    try:
        content = json.loads(read(path))
        robots = {str(name): bytes.fromhex(key) for name, key in content["robots"].items()}
        classes = content.get("compute_classes")
        members = Members(
            str(content["swarm"]),
            robots,
            tuple(str(name) for name in content["operators"]),
            None if classes is None else {str(name): int(each) for name, each in classes.items()},
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise TransportError(f"{path}: is not a list of members: {error}") from error
    names = [*members.robots, *members.operators, *(members.compute_classes or ())]
    if len(names) > MEMBERS_MAX or not all(NAME_PATTERN.fullmatch(name) for name in names):
        raise TransportError(f"{path}: holds more than {MEMBERS_MAX} names, or one that is no name")
    return members


def read(path: Path) -> bytes:
    """Read a file.

    Raises:
        TransportError: It cannot be read; the message names it.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise TransportError(f"{path}: cannot be read: {error.strerror}") from error


def is_operator(tls: TlsConfig) -> bool:
    """Whether a folder of keys is of somebody who may ask for status and inject faults.

    Raises:
        TransportError: A file is missing or not what it should be.
    """
    _check_installed()
    from cryptography import x509

    try:
        subject = x509.load_pem_x509_certificate(read(tls.folder / CERTIFICATE)).subject
    except ValueError as error:
        raise TransportError(f"{tls.folder / CERTIFICATE}: is no certificate: {error}") from error
    names = {str(each.value) for each in subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)}
    return not names.isdisjoint(read_members(tls.folder / MEMBERS).operators)


def secure_settings(tls: TlsConfig, swarm: str, robot: str) -> dict[str, Any]:
    """Give zenoh's settings for mutual TLS, nothing but TLS, and one writer per key.

    Raises:
        TransportError: A file is missing or unreadable, or this robot is not a member of this swarm.
    """
    members = check_member(tls, swarm, robot)
    return tls_settings(tls) | {"access_control": access_control(swarm, members.robots, members.operators)}


def check_member(tls: TlsConfig, swarm: str, robot: str) -> Members:
    """Read who belongs to a swarm, and see that this robot or operator does.

    Raises:
        TransportError: The list is missing, unreadable or of another swarm, or does not name it.
    """
    members = read_members(tls.folder / MEMBERS)
    if members.swarm != swarm:
        raise TransportError(f"{tls.folder / MEMBERS}: is of swarm {members.swarm}, not of {swarm}")
    if robot not in members.robots and robot not in members.operators:
        raise TransportError(f"{tls.folder / MEMBERS}: does not name {robot}")
    return members


def tls_settings(tls: TlsConfig) -> dict[str, Any]:
    """Give zenoh's settings for mutual TLS.

    Raises:
        TransportError: A file is missing or unreadable; the message names it.
    """
    ca, certificate, key = (tls.folder / name for name in (CA, CERTIFICATE, KEY))
    for path in (ca, certificate, key):
        read(path)
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls/root_ca_certificate": str(ca),
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/listen_private_key": str(key),
        "transport/link/tls/listen_certificate": str(certificate),
        "transport/link/tls/connect_private_key": str(key),
        "transport/link/tls/connect_certificate": str(certificate),
        "transport/link/tls/verify_name_on_connect": False,
    }


def access_control(swarm: str, robots: Iterable[str], operators: Iterable[str]) -> dict[str, Any]:
    """Give zenoh's access rules: whoever is certified reads the swarm, each robot writes under its own name only.

    Rules apply to what comes in, by the common name of the link's certificate; what is not allowed is dropped.
    """
    everything = f"{keys.ROOT}/{keys.VERSION}/{swarm}/**"
    latents = f"{keys.ROOT}/{keys.VERSION}/{swarm}/*/{keys.LATENT}/**"
    admin = [keys.admin_key(swarm, "*", each) for each in keys.Admin]
    robots, operators = sorted(set(robots)), sorted(set(operators))
    everybody = sorted({*robots, *operators})
    rules = [
        _rule("read", READS, [everything, keys.presence_pattern()], ["ingress"]),
        _rule("fetch", ["query"], [latents], ["ingress"]),
        _rule("send", [*WRITES, *READS, "query"], ["**"], ["egress"]),
        _rule("operate", ["query"], admin, ["ingress"]),
        *(_rule(f"write-{name}", WRITES, [f"{keys.robot_prefix(swarm, name)}/**"], ["ingress"]) for name in robots),
    ]
    policies = [
        {"rules": ["read", "fetch", "send"], "subjects": everybody},
        *({"rules": [f"write-{name}"], "subjects": [name]} for name in robots),
        *([{"rules": ["operate"], "subjects": operators}] if operators else []),
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in everybody],
        "policies": policies,
    }


def _rule(name: str, messages: list[str], key_exprs: list[str], flows: list[str]) -> dict[str, Any]:
    return {"id": name, "messages": messages, "flows": flows, "permission": "allow", "key_exprs": key_exprs}


class RecordSealer:
    """Signs this robot's records and checks those of all members: record bytes in, record bytes plus 64 out.

    The signature covers swarm, log and number as well, so that a record cannot be moved to another place. Corrections
    are signed by the leader that made them, apart from their bytes. What was checked beforehand, on another thread, is
    not checked again.

    Attributes:
        compute_classes: Those of the list of members, None where it names none.
    """

    def __init__(
        self,
        swarm: str,
        signing_key: "Ed25519PrivateKey",
        members: Mapping[str, bytes],
        compute_classes: Mapping[str, int] | None = None,
    ) -> None:
        self.compute_classes = compute_classes
        self._swarm = swarm
        self._signing_key = signing_key
        self._verifying_keys = {robot: _public_key(key) for robot, key in members.items()}
        self._verdicts: dict[bytes, bool] = {}

    @classmethod
    def of(cls, tls: TlsConfig, robot: str | None = None) -> "RecordSealer":
        """Read this robot's signing key and the members' public ones.

        Args:
            tls: Where they are.
            robot: Whose key it must be; None: any member's.

        Raises:
            TransportError: A file is missing or not a key, the key is of another robot, or the extra `secure` is not
                installed.
        """
        _check_installed()
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        from cryptography.hazmat.primitives.serialization import load_pem_private_key

        path = tls.folder / SIGNING_KEY
        try:
            signing_key = load_pem_private_key(read(path), password=None)
        except ValueError as error:
            raise TransportError(f"{path}: is not a private key") from error
        if not isinstance(signing_key, Ed25519PrivateKey):
            raise TransportError(f"{path}: is not an Ed25519 key")
        members = read_members(tls.folder / MEMBERS)
        if robot is not None:
            public_key = signing_key.public_key().public_bytes_raw()
            owner = next((name for name, key in members.robots.items() if key == public_key), None)
            if owner != robot:
                whose = f"is the key of robot {owner}" if owner else "is the key of no member of the swarm"
                raise TransportError(
                    f"{path}: {whose}, and this robot is named {robot}; its keys are in another folder"
                )
        return cls(members.swarm, signing_key, members.robots, members.compute_classes)

    def seal(self, log: LogId, number: int, record: bytes) -> bytes:
        """Append this robot's signature to a record of its own log."""
        return record + self._signing_key.sign(signed_text(self._swarm, log, number, record))

    def opened(self, log: LogId, number: int, sealed: bytes) -> bytes:
        """Give the record without its signature, once that is checked.

        Raises:
            DecodeError: The robot is no member, or its signature is missing or wrong.
        """
        record, signature = sealed[:-SIGNATURE_BYTES], sealed[-SIGNATURE_BYTES:]
        if not self._is_of(log, signature, signed_text(self._swarm, log, number, record)):
            raise DecodeError(f"record {number} of log {log} carries no signature of {log.robot}")
        return record

    def sign_correction(self, correction: bytes) -> bytes:
        """Give this robot's signature of a correction that it made as a leader."""
        return self._signing_key.sign(signed_correction(self._swarm, correction))

    def check_correction(self, leader: LogId, correction: bytes, signature: bytes) -> None:
        """Check who made a correction.

        Raises:
            DecodeError: The leader is no member, or its signature is missing or wrong.
        """
        if not self._is_of(leader, signature, signed_correction(self._swarm, correction)):
            raise DecodeError(f"a correction carries no signature of {leader.robot}")

    def check(self, messages: Sequence[Sequence[Claim]]) -> list[int]:
        """Check what a robot is about to ask for, message by message; on one other thread, while the robot goes on.

        What is claimed of a robot after one of its signatures in a message was wrong is not looked at.

        Returns:
            How many signatures of each message were looked at.
        """
        return [self._check(claims) for claims in messages]

    def _check(self, claims: Sequence[Claim]) -> int:
        failed: set[str] = set()
        looked_at = 0
        for claim in claims:
            signer, signature, text = self._claimed(claim)
            if signer.robot in failed or signer.robot not in self._verifying_keys:
                continue
            digest = _digest(signer, signature, text)
            verdict = self._verdicts.get(digest)
            if verdict is None:
                looked_at += 1
                verdict = self._verify(signer, signature, text)
                remember(self._verdicts, digest, verdict, VERDICTS_MAX)
            if not verdict:
                failed.add(signer.robot)
        return looked_at

    def _claimed(self, claim: Claim) -> tuple[LogId, bytes, bytes]:
        """Who is said to have signed what, and the signature."""
        if not isinstance(claim, RecordClaim):
            return claim.leader, claim.signature, signed_correction(self._swarm, claim.correction)
        record, signature = claim.sealed[:-SIGNATURE_BYTES], claim.sealed[-SIGNATURE_BYTES:]
        return claim.log, signature, signed_text(self._swarm, claim.log, claim.number, record)

    def _is_of(self, log: LogId, signature: bytes, text: bytes) -> bool:
        """Whether the robot of a log signed a text.

        Raises:
            DecodeError: The robot is no member.
        """
        if log.robot not in self._verifying_keys:
            raise DecodeError(f"log {log} is of no member of the swarm")
        known = self._verdicts.get(_digest(log, signature, text)) if self._verdicts else None
        return self._verify(log, signature, text) if known is None else known

    def _verify(self, log: LogId, signature: bytes, text: bytes) -> bool:
        from cryptography.exceptions import InvalidSignature

        try:
            self._verifying_keys[log.robot].verify(signature, text)
        except InvalidSignature:
            return False
        return True


def _digest(log: LogId, signature: bytes, text: bytes) -> bytes:
    """Names one check: whose signature, which, and over what."""
    return blake2b(bytes([len(signature)]) + signature + text, digest_size=32, key=log.robot.encode()).digest()


def signed_text(swarm: str, log: LogId, number: int, record: bytes) -> bytes:
    """Give what a record's signature covers: where the record stands, unambiguously, then the record."""
    return _placed(f"{keys.ROOT}/{keys.VERSION}/{swarm}/{log}/{number}", record)


def signed_correction(swarm: str, correction: bytes) -> bytes:
    """Give what a correction's signature covers; no log's place ends in this word, since that is a number."""
    return _placed(f"{keys.ROOT}/{keys.VERSION}/{swarm}/correction", correction)


def _placed(place: str, content: bytes) -> bytes:
    data = place.encode()
    return struct.pack(">H", len(data)) + data + content


def _public_key(raw: bytes) -> "Ed25519PublicKey":
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    return Ed25519PublicKey.from_public_bytes(raw)


def _check_installed() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError as error:
        raise TransportError(f"signed records need the extra 'secure': {to_install('secure')}") from error
