"""Certificates that do not hold now, or not for long: without them a robot runs alone, and zenoh says nothing."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from flocc_agent.config import TlsConfig
from flocc_agent.runtime.security import CA, CERTIFICATE, KEY, read
from flocc_agent.runtime.transport import TransportError

if TYPE_CHECKING:
    from cryptography import x509

SOON = timedelta(days=30)
RENEWAL = "remove it and its key, and run 'flocc keys' again"


def certificate_faults(tls: TlsConfig | None, now: datetime | None = None) -> Iterator[str]:
    """One sentence for each certificate that has expired, is not valid yet, ends within a month, or is of others."""
    moment = now or datetime.now(UTC)
    if tls is not None and _is_foreign(tls):
        yield _foreign(tls)
    for path in () if tls is None else (tls.folder / CERTIFICATE, tls.folder / CA):
        try:
            begins, ends = _validity(path)
        except (TransportError, ImportError, ValueError):
            continue  # whoever opens the network says what is wrong with the file
        if ends <= moment:
            yield f"{path}: expired on {ends:%Y-%m-%d}: nobody accepts it; {RENEWAL}"
        elif begins > moment:
            yield f"{path}: is valid from {begins:%Y-%m-%d} on, and the clock says {moment:%Y-%m-%d}; nobody is heard"
        elif ends <= moment + SOON:
            yield f"{path}: expires on {ends:%Y-%m-%d}; {RENEWAL}"


def _validity(path: Path) -> tuple[datetime, datetime]:
    from cryptography import x509

    certificate = x509.load_pem_x509_certificate(read(path))
    return certificate.not_valid_before_utc, certificate.not_valid_after_utc


def check_certificate(tls: TlsConfig, robot: str) -> None:
    """See that a robot's certificate is its own, that its key is there, and that whoever has this authority accepts it.

    zenoh opens with any certificate and says nothing when others turn it away: such a robot would lead itself for ever.

    Raises:
        TransportError: It is not; the message names the file.
    """
    from cryptography.hazmat.primitives.serialization import load_pem_private_key
    from cryptography.x509.oid import NameOID

    path, key = tls.folder / CERTIFICATE, tls.folder / KEY
    chain, authorities = _certificates(path), _certificates(tls.folder / CA)
    if not _rests_on(chain, authorities):
        raise TransportError(_foreign(tls))
    names = [str(each.value) for each in chain[0].subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    if robot not in names:
        whose = ", ".join(names) or "nobody"
        raise TransportError(f"{path}: is of {whose}, and this robot is named {robot}; its keys are in another folder")
    try:
        public = load_pem_private_key(read(key), password=None).public_key()
    except (ValueError, TypeError) as error:
        raise TransportError(f"{key}: is not a private key") from error
    if public != chain[0].public_key():
        raise TransportError(f"{key}: is not the key of {path}; both come from one run of 'flocc keys'")


def _is_foreign(tls: TlsConfig) -> bool:
    try:
        return not _rests_on(_certificates(tls.folder / CERTIFICATE), _certificates(tls.folder / CA))
    except (TransportError, ImportError):
        return False  # whoever opens the network says what is wrong with the file


def _foreign(tls: TlsConfig) -> str:
    return (
        f"{tls.folder / CERTIFICATE}: was not made by the authority of {tls.folder / CA}, so that nobody accepts it; "
        "bring both from the folder that 'flocc keys' wrote"
    )


def _rests_on(chain: "list[x509.Certificate]", authorities: "list[x509.Certificate]") -> bool:
    """Whether the first of a chain was signed by an authority, over others of the chain where there are more."""
    current = chain[0]
    for _ in chain:
        if any(_signed_by(current, each) for each in authorities):
            return True
        current = next((each for each in chain[1:] if _signed_by(current, each)), current)
    return False


def _signed_by(certificate: "x509.Certificate", issuer: "x509.Certificate") -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(issuer)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def _certificates(path: Path) -> "list[x509.Certificate]":
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificates(read(path))
    except ValueError as error:
        raise TransportError(f"{path}: is no certificate: {error}") from error
