"""Names for robots: those that keys can hold, and alpha, bravo, charlie, as over the radio, for robots without one."""

import re

NAME_LENGTH_MAX = 32
RADIO_ALPHABET = tuple(
    """
    alpha bravo charlie delta echo foxtrot golf hotel india juliett kilo lima mike
    november oscar papa quebec romeo sierra tango uniform victor whiskey xray yankee zulu
    """.split()  # noqa: SIM905
)


def robot_names(count: int) -> list[str]:
    """The first `count` names; they sort in the order in which they are given.

    Raises:
        ValueError: Not at least one robot.
    """
    if count < 1:
        raise ValueError(f"a team of {count} robots has no names")
    spelled = list(RADIO_ALPHABET[:count])
    return spelled + [f"zulu-{index:03d}" for index in range(1, count - len(spelled) + 1)]


def robot_name(text: str) -> str:
    """A name that keys can hold, made of a folder's or a namespace's."""
    return re.sub(r"[^a-z0-9_-]+", "-", text.lower()).strip("-_")[:NAME_LENGTH_MAX] or "robots"
