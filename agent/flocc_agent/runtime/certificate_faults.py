"""Certificates that do not hold now, or not for long: without them a robot runs alone, and zenoh says nothing."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from flocc_agent.config import TlsConfig
from flocc_agent.runtime.security import CA, CERTIFICATE, read
from flocc_agent.runtime.transport import TransportError

SOON = timedelta(days=30)
RENEWAL = "remove it and its key, and run 'flocc keys' again"


def certificate_faults(tls: TlsConfig | None, now: datetime | None = None) -> Iterator[str]:
    """One sentence for each certificate that has expired, is not valid yet, or ends within a month."""
    moment = now or datetime.now(UTC)
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
