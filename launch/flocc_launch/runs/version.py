"""The version of flocc that made a run."""

from importlib.metadata import PackageNotFoundError, version


def flocc_version() -> str:
    """Version of the installed distribution, or 'unknown' when run from a source tree alone."""
    try:
        return version("flocc")
    except PackageNotFoundError:
        return "unknown"
