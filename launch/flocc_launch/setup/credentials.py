"""`flocc keys`: a swarm's authority, a certificate and a signing key per robot, ready to be copied.

    FOLDER/authority/   ca.crt, ca.key: stays here; whoever has ca.key can admit robots
    FOLDER/ROBOT/       ca.crt, robot.crt, robot.key, signing.key, members.json: belongs on that robot

Running it again with more names admits more robots; existing keys stay. All robots then need the new members.json.
"""

import ipaddress
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flocc_agent.extras import to_install
from flocc_agent.runtime.security import CA, CERTIFICATE, KEY, MEMBERS, SIGNING_KEY
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import checked_name

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

AUTHORITY, CA_KEY = "authority", "ca.key"
AUTHORITY_DAYS = 3650
ROBOT_DAYS = 1825
CLOCK_MARGIN = timedelta(days=1)
OPERATORS = ("operator",)


class KeysError(FloccError):
    """Keys that cannot be made or read; the message names the file."""


@dataclass(frozen=True, slots=True)
class Authority:
    """Who certifies robots."""

    certificate: "x509.Certificate"
    key: "EllipticCurvePrivateKey"


def make_keys(
    folder: Path,
    swarm: str,
    robots: Iterable[str],
    operators: Iterable[str] = OPERATORS,
    addresses: Mapping[str, Iterable[str]] | None = None,
    now: datetime | None = None,
    compute_classes: Mapping[str, int] | None = None,
) -> dict[str, Path]:
    """Make what is missing: the authority, and keys for each robot and operator.

    Args:
        folder: Where the authority and a folder per robot stand or will stand.
        swarm: Name of the swarm; one authority certifies one swarm.
        robots: Names of robots to admit.
        operators: Names of people who may ask for status and inject faults.
        addresses: IP addresses or host names of each robot, written into its certificate.
        now: Begin of validity; None is the clock's time.
        compute_classes: Of robots; where any was ever given, all others have 0 and nobody can claim another one.

    Returns:
        Each member's folder, also of those admitted earlier.

    Raises:
        KeysError: The folder is of another swarm, cannot be written, lacks what its members' certificates rest on, or
            `cryptography` is not installed.
        BadName: A name that no robot can have.
    """
    _check_installed()
    moment = now or datetime.now(UTC)
    of_robots, of_operators = set(map(checked_name, robots)), set(map(checked_name, operators))
    names = dict.fromkeys(of_robots, "robots") | dict.fromkeys(of_operators, "operators")
    try:
        members = _members(folder / AUTHORITY / MEMBERS, swarm)
        known_robots, known_operators = of_robots | set(members["robots"]), of_operators | set(members["operators"])
        for name in sorted(known_robots & {AUTHORITY, *known_operators}):
            raise KeysError(f"{folder}: no robot can be named {name!r} here")
        authority = _authority(folder / AUTHORITY, checked_name(swarm, "swarm name"), moment)
        for name, role in sorted(names.items()):
            _check_at_home(folder, name, members[role].get(name))
        for name, role in sorted(names.items()):
            public_key = _member_keys(folder / name, name, authority, list((addresses or {}).get(name, ())), moment)
            members[role][name] = public_key.hex()
        members["compute_classes"] |= compute_classes or {}
        return _publish(folder, swarm, members, authority)
    except OSError as error:
        raise KeysError(f"{error.filename or folder}: cannot be written: {error.strerror}") from error


def _publish(folder: Path, swarm: str, members: dict[str, dict[str, Any]], authority: Authority) -> dict[str, Path]:
    """Give every member the list of members and the authority's certificate."""
    from cryptography.hazmat.primitives.serialization import Encoding

    content = {"swarm": swarm, "robots": members["robots"], "operators": sorted(members["operators"])}
    if members["compute_classes"]:
        content["compute_classes"] = members["compute_classes"]
    listed = json.dumps(content, indent=2, sort_keys=True).encode() + b"\n"
    folders = {name: folder / name for role in ("robots", "operators") for name in members[role]}
    for path in (folder / AUTHORITY, *folders.values()):
        path.mkdir(parents=True, exist_ok=True)
        _write(path / MEMBERS, listed)
        _write(path / CA, authority.certificate.public_bytes(Encoding.PEM))
    return dict(sorted(folders.items()))


def _members(path: Path, swarm: str) -> dict[str, dict[str, Any]]:
    """Read the members admitted so far."""
    if not path.exists():
        return {"robots": {}, "operators": {}, "compute_classes": {}}
    try:
        content = json.loads(path.read_bytes())
        of_swarm, robots = str(content["swarm"]), {str(name): str(key) for name, key in content["robots"].items()}
        operators = dict.fromkeys(map(checked_name, content["operators"]), "")
        classes = {str(name): int(each) for name, each in content.get("compute_classes", {}).items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise KeysError(f"{path}: is not a list of members: {error}") from error
    if of_swarm != swarm:
        raise KeysError(f"{path}: is of swarm {of_swarm}, not of {swarm}")
    return {"robots": robots, "operators": operators, "compute_classes": classes}


def _check_at_home(folder: Path, name: str, listed: str | None) -> None:
    """See that a member's keys here are those that the list of members names: others know it by these.

    Raises:
        KeysError: They are gone, or are others.
    """
    path = folder / name / SIGNING_KEY
    if listed and (not path.exists() or _signing_key(path).hex() != listed):
        members = folder / AUTHORITY / MEMBERS
        raise KeysError(
            f"{path}: is not the key by which {members} knows {name}: name the new robots only, "
            f"or delete {name} from that list to give it new keys"
        )


def _authority(folder: Path, swarm: str, now: datetime) -> Authority:
    """Read the authority, or make one."""
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    if (folder / CA_KEY).exists() or any(folder.parent.glob(f"*/{CA}")):
        for path in (folder / CA_KEY, folder / CA):
            if not path.exists():
                raise KeysError(
                    f"{path}: is gone, and the certificates beside it rest on it: bring it back from a copy, or make "
                    "keys for all robots in another folder"
                )
        try:
            key = load_pem_private_key((folder / CA_KEY).read_bytes(), password=None)
            certificate = x509.load_pem_x509_certificate((folder / CA).read_bytes())
        except ValueError as error:
            raise KeysError(f"{folder}: holds no readable authority: {error}") from error
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        return Authority(certificate, key)
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"flocc swarm {swarm}")
    certificate = (
        _certificate(name, name, key, now, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, _hash())
    )
    folder.mkdir(parents=True, exist_ok=True)
    _write_private(folder / CA_KEY, _pem(key))
    _write(folder / CA, _certificate_pem(certificate))
    return Authority(certificate, key)


def _member_keys(folder: Path, name: str, authority: Authority, addresses: list[str], now: datetime) -> bytes:
    """Make a member's keys where they are missing, and give its public signing key."""
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

    folder.mkdir(parents=True, exist_ok=True)
    if not ((folder / KEY).exists() and (folder / CERTIFICATE).exists()):
        key = ec.generate_private_key(ec.SECP256R1())
        purposes = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        certificate = (
            _certificate(_name(name), authority.certificate.subject, key, now, ROBOT_DAYS)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
            .add_extension(x509.SubjectAlternativeName(_alternative_names(name, addresses)), critical=False)
            .sign(authority.key, _hash())
        )
        _write(folder / CERTIFICATE, _certificate_pem(certificate))
        _write_private(folder / KEY, _pem(key))
    return _signing_key(folder / SIGNING_KEY)


def _signing_key(path: Path) -> bytes:
    """Make a signing key where there is none, and give its public half, 32 bytes."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    if path.exists():
        try:
            key = load_pem_private_key(path.read_bytes(), password=None)
        except ValueError as error:
            raise KeysError(f"{path}: is not a private key") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise KeysError(f"{path}: is not an Ed25519 key")
    else:
        key = Ed25519PrivateKey.generate()
        _write_private(path, _pem(key))
    return key.public_key().public_bytes_raw()


def _certificate(
    subject: "x509.Name", issuer: "x509.Name", key: "EllipticCurvePrivateKey", now: datetime, days: int
) -> "x509.CertificateBuilder":
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_MARGIN)
        .not_valid_after(now + timedelta(days=days))
    )


def _alternative_names(name: str, addresses: list[str]) -> "list[x509.GeneralName]":
    from cryptography import x509

    names: list[x509.GeneralName] = [x509.DNSName(name)]
    for address in addresses:
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(address)))
        except ValueError:
            names.append(x509.DNSName(address))
    return names


def _name(text: str) -> "x509.Name":
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _hash() -> "hashes.SHA256":
    from cryptography.hazmat.primitives import hashes

    return hashes.SHA256()


def _pem(key: "EllipticCurvePrivateKey | Ed25519PrivateKey") -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _certificate_pem(certificate: "x509.Certificate") -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding

    return certificate.public_bytes(Encoding.PEM)


def _write(path: Path, content: bytes) -> None:
    """Write a file so that it is either the old one or the whole new one."""
    temporary = path.with_name(path.name + ".new")
    temporary.write_bytes(content)
    temporary.replace(path)


def _write_private(path: Path, content: bytes) -> None:
    """Write a file that only its owner can read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)


def _check_installed() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError as error:
        raise KeysError(f"flocc keys needs the extra 'secure': {to_install('secure')}") from error
