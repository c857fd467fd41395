"""The grammar of flocc's zenoh keys, all of it: one writer per key, the version in the second chunk.

    flocc/v2/SWARM/ROBOT/KIND                  broadcast to every robot in range, such as KIND `heartbeat`
    flocc/v2/SWARM/ROBOT/to/RECEIVER/KIND      to one robot in range
    flocc/v2/SWARM/ROBOT/latent/LOG/INDEX      queryable: the latent of one keyframe, held by ROBOT
    flocc/v2/SWARM/ROBOT/status                queryable: what this agent knows and counts
    flocc/v2/SWARM/ROBOT/chaos                 queryable: faults on demand
    flocc/v2/SWARM/ROBOT/alive/BOOT            liveliness token of one start of one robot

ROBOT always is the writer (or the one who answers), so the sender is read from the key and an access rule per
robot, `flocc/v2/SWARM/ROBOT/**`, says who may write what. Payloads carry their own version byte as well.
"""

import re
from dataclasses import dataclass
from enum import Enum, StrEnum

from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import NAME_PATTERN, checked_name

ROOT = "flocc"
VERSION = "v2"
KEY_CHARACTERS_MAX = 256

KIND_PATTERN = re.compile(r"[a-z][a-z0-9_-]{0,15}")
LATENT_PATTERN = re.compile(r"[a-z0-9_~-]{1,64}(/[a-z0-9_~-]{1,16}){0,3}")
BOOT_PATTERN = re.compile(r"[0-9a-f]{1,32}")


class Kind(StrEnum):
    """What is said, by its chunk in the key: the kinds of messages, the most urgent first."""

    HEARTBEAT = "heartbeat"
    ELECTION = "election"
    ANSWER = "answer"
    COORDINATOR = "coordinator"
    HANDOVER = "handover"
    CORRECTION = "correction"
    CORRECTION_REQUEST = "want-correction"
    KNOT_REQUEST = "want-knots"
    DIGESTS = "digests"
    DIGEST_REQUEST = "want-digests"
    RECORDS = "records"
    RECORD_REQUEST = "want-records"
    CANDIDATES = "candidates"
    SHARED_POSES = "shared-poses"


class Admin(StrEnum):
    """What an operator asks of an agent."""

    STATUS = "status"
    CHAOS = "chaos"


TO, LATENT, ALIVE = "to", "latent", "alive"
RESERVED = frozenset({TO, LATENT, ALIVE, *(admin.value for admin in Admin)})


@dataclass(frozen=True, slots=True)
class Address:
    """Who wrote a message, of which kind, and to whom; no receiver means everybody in range."""

    swarm: str
    sender: str
    kind: str
    receiver: str | None = None


@dataclass(frozen=True, slots=True)
class Presence:
    """A liveliness token: one start (boot) of one robot that speaks one protocol version."""

    version: str
    swarm: str
    robot: str
    boot: str


def checked_kind(kind: str) -> str:
    """Return the kind as plain text, or say why it cannot be a chunk of a key.

    Raises:
        ValueError: Not 1 to 16 of a-z, 0-9, '-', '_' from a letter on, or a word that the grammar reserves.
    """
    text = str(kind.value) if isinstance(kind, Enum) else kind
    if not KIND_PATTERN.fullmatch(text) or text in RESERVED:
        raise ValueError(f"message kind {text!r} cannot be a chunk of a key")
    return text


def broadcast_key(swarm: str, sender: str, kind: str) -> str:
    """Key under which a robot speaks to everybody in range."""
    return f"{robot_prefix(swarm, sender)}/{checked_kind(kind)}"


def unicast_key(swarm: str, sender: str, receiver: str, kind: str) -> str:
    """Key under which a robot speaks to one robot in range."""
    return f"{robot_prefix(swarm, sender)}/{TO}/{checked_name(receiver)}/{checked_kind(kind)}"


def latent_key(swarm: str, holder: str, latent: str) -> str:
    """Key at which a robot answers with a latent; the latent is named by its keyframe, `LOG/INDEX`.

    Raises:
        ValueError: The latent's name cannot be part of a key.
    """
    if not LATENT_PATTERN.fullmatch(latent):
        raise ValueError(f"latent name {latent!r} cannot be part of a key")
    return f"{robot_prefix(swarm, holder)}/{LATENT}/{latent}"


def admin_key(swarm: str, robot: str, admin: Admin) -> str:
    """Key at which an agent answers an operator; robot '*' asks all of them."""
    prefix = f"{ROOT}/{VERSION}/{checked_name(swarm, 'swarm name')}/*" if robot == "*" else robot_prefix(swarm, robot)
    return f"{prefix}/{admin.value}"


def alive_key(swarm: str, robot: str, boot: str) -> str:
    """Key of a robot's liveliness token; boot is lower-case hexadecimal, new at each start.

    Raises:
        ValueError: The boot is not 1 to 32 hexadecimal digits.
    """
    if not BOOT_PATTERN.fullmatch(boot):
        raise ValueError(f"boot {boot!r} is not hexadecimal")
    return f"{robot_prefix(swarm, robot)}/{ALIVE}/{boot}"


def robot_prefix(swarm: str, robot: str) -> str:
    """Everything that a robot writes begins with this.

    Raises:
        BadName: The swarm's or the robot's name cannot be a chunk of a key.
    """
    return f"{ROOT}/{VERSION}/{checked_name(swarm, 'swarm name')}/{checked_name(robot)}"


def broadcasts_pattern(swarm: str) -> str:
    """Matches every broadcast in a swarm."""
    return f"{ROOT}/{VERSION}/{checked_name(swarm, 'swarm name')}/*/*"


def kind_pattern(swarm: str, kind: str) -> str:
    """Matches the broadcasts of one kind in a swarm."""
    return f"{ROOT}/{VERSION}/{checked_name(swarm, 'swarm name')}/*/{checked_kind(kind)}"


def unicasts_pattern(swarm: str, receiver: str) -> str:
    """Matches every message to one robot, whoever sends it."""
    return f"{ROOT}/{VERSION}/{checked_name(swarm, 'swarm name')}/*/{TO}/{checked_name(receiver)}/*"


def latents_pattern(swarm: str, holder: str) -> str:
    """Matches every latent that a robot holds."""
    return f"{robot_prefix(swarm, holder)}/{LATENT}/**"


def presence_pattern() -> str:
    """Matches the liveliness tokens of all swarms and versions, so that strangers can be named."""
    return f"{ROOT}/*/*/*/{ALIVE}/*"


def parse_message_key(text: str) -> Address:
    """Read the address of a broadcast or a unicast from its key.

    Raises:
        DecodeError: Not such a key of this protocol version.
    """
    swarm, sender, rest = _split(text)
    match rest:
        case [kind]:
            return Address(swarm, sender, _received_kind(kind, text))
        case ["to", receiver, kind] if NAME_PATTERN.fullmatch(receiver):
            return Address(swarm, sender, _received_kind(kind, text), receiver)
        case _:
            raise DecodeError(f"key {text[:KEY_CHARACTERS_MAX]!r} addresses no message")


def parse_latent_key(text: str) -> tuple[str, str]:
    """Read (holder, latent) from the key of a latent.

    Raises:
        DecodeError: Not such a key of this protocol version.
    """
    _, holder, rest = _split(text)
    latent = "/".join(rest[1:])
    if rest[0] != LATENT or not LATENT_PATTERN.fullmatch(latent):
        raise DecodeError(f"key {text[:KEY_CHARACTERS_MAX]!r} names no latent")
    return holder, latent


def parse_admin_key(text: str) -> str:
    """Read which robot answers under the key of an operator's request.

    Raises:
        DecodeError: Not such a key of this protocol version.
    """
    _, robot, rest = _split(text)
    if rest not in [[admin.value] for admin in Admin]:
        raise DecodeError(f"key {text[:KEY_CHARACTERS_MAX]!r} is no operator's request")
    return robot


def parse_alive_key(text: str) -> Presence:
    """Read a liveliness token, of any version and swarm.

    Raises:
        DecodeError: Not such a key.
    """
    chunks = text[: KEY_CHARACTERS_MAX + 1].split("/")
    match chunks:
        case ["flocc", version, swarm, robot, "alive", boot] if (
            len(text) <= KEY_CHARACTERS_MAX
            and all(NAME_PATTERN.fullmatch(name) for name in (version, swarm, robot))
            and BOOT_PATTERN.fullmatch(boot)
        ):
            return Presence(version, swarm, robot, boot)
        case _:
            raise DecodeError(f"key {text[:KEY_CHARACTERS_MAX]!r} is no liveliness token")


def _split(text: str) -> tuple[str, str, list[str]]:
    """Swarm, robot and the remaining chunks of a key of this version."""
    chunks = text[: KEY_CHARACTERS_MAX + 1].split("/")
    if len(text) > KEY_CHARACTERS_MAX or len(chunks) < 5 or chunks[0] != ROOT:
        raise DecodeError(f"key {text[:KEY_CHARACTERS_MAX]!r} is not of flocc")
    if chunks[1] != VERSION:
        raise DecodeError(f"key {text!r} is of protocol version {chunks[1]!r}, this robot speaks {VERSION!r}")
    if not NAME_PATTERN.fullmatch(chunks[2]) or not NAME_PATTERN.fullmatch(chunks[3]):
        raise DecodeError(f"key {text!r} holds no valid swarm and robot name")
    return chunks[2], chunks[3], chunks[4:]


def _received_kind(kind: str, key: str) -> str:
    if not KIND_PATTERN.fullmatch(kind) or kind in RESERVED:
        raise DecodeError(f"key {key!r} names no kind of message")
    return kind
