"""The root of every error that flocc raises on purpose."""


class FloccError(Exception):
    """Root of flocc's errors: bad input, a refused message, a world that does not allow what was asked."""


class DecodeError(FloccError):
    """Bytes from elsewhere are not a valid message of this protocol version; drop, count, carry on."""
