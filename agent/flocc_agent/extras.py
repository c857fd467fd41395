"""How an optional part is installed: one sentence for every message that names one."""


def to_install(extra: str) -> str:
    """What to type for an extra of flocc's, in a folder that holds a clone of it."""
    return f"pip install '.[{extra}]' in the clone of flocc"
