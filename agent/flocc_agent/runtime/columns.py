"""What the columns of a trajectory mean, by the line that names them: `timestamp [ns], p_RS_R_x [m], ..., q_RS_w []`.

Names differ from tool to tool, but say the same: a group (position, quaternion) and an axis. A header that names
something twice, or only a part, is refused by its reader; what is not understood is kept by name, so that the reader
accounts for it (`spare_columns`).
"""

import re
from dataclasses import dataclass

UNITS_S = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
ROLES_MIN = 4
"""A line that names fewer columns of a trajectory is a comment."""
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")

_UNIT_NAMES = {
    "seconds": ("s", "sec", "secs", "second", "seconds"),
    "milliseconds": ("ms", "msec", "msecs", "millis", "millisec", "millisecond", "milliseconds"),
    "microseconds": ("us", "µs", "μs", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds"),
    "nanoseconds": ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds"),
}
_OTHER_UNITS = (
    *("min", "mins", "minute", "minutes", "h", "hr", "hrs", "hour", "hours", "d", "day", "days"),
    *("frame", "frames", "tick", "ticks", "sample", "samples", "cycle", "cycles", "100ns", "10us", "100us", "week"),
)
"""What stamps are sometimes counted in, and flocc does not read."""
_METRES = {"": 1.0, "m": 1.0, "meter": 1.0, "meters": 1.0, "metres": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3}
_UNIT_OF = {name: unit for unit, names in _UNIT_NAMES.items() for name in names}
_STAMP = re.compile(r"(.*[._/])?(t|ts|time|times|stamp|timestamp|timestamp_kf|time_stamp|unix_?time|epoch|utc|clock)")
_HEADER_STAMP = re.compile(r"(.*[._/])?header[._/]stamp([._/]secs?)?")
_POSITION = re.compile(
    r"|t|p|pose|pos|position|trans|translation|loc|location|[pt]_\w+|(.*[._/])?(position|translation)(_\w+)?"
)
_QUATERNION = re.compile(
    r"(.*[._/])?q|o|quat|quaternion|rot|rotation|ori|orient|orientation|q_\w+|(.*[._/])?(orientation|rotation|quaternion|quat)"
)
_ANGLES = re.compile(r"(.*[._/])?(roll|pitch|yaw|heading|azimuth|euler_?\w*|rx|ry|rz|phi|theta|psi)(_\w+)?")
_ORDER = re.compile(
    r"\b(q|quat|quaternion)[\w ]*?[ _(\[]+([wxyz])[, ]?([wxyz])[, ]?([wxyz])[, ]?([wxyz])[)\]]?(?=[\s,;]|$)"
)
"""A quaternion in one word, `q_wxyz` or `quat(x,y,z,w)`."""
_REVERSED = re.compile(
    r"(?:^|_)(?:[bcis][wg]|(?:cam|camera|body|imu|base)_?(?:world|map|odom|global)"
    r"|(?:world|map|odom|global|w|g)_?(?:to|2|in)_?(?:cam|camera|body|imu|base|[bcis])(?:_?link)?)(?:_|$)"
)
"""A pose of the fixed frame in the moving one: `q_cw_x`, `p_BW_y`, `t_world_to_cam_z`."""
_REVERSED_WORDS = re.compile(
    r"(?:^|_)(?:t_?[bci]_?[wg]|t_?(?:cam|camera|body|imu)_?(?:world|global)|w2c"
    r"|(?:[bci]|cam|camera|body|imu|sensor|frame|device)_t_(?:[wg]|world|global|map|odom)"
    r"|(?:world|global)_?(?:to|2)_?(?:cam|camera|body|imu)|(?:cam|camera|body|imu)_from_(?:world|global|map))(?:_|$)"
)
"""The same in a comment, whose words mean less: `T_body_world`, `frame_T_global`, `world to camera`."""
_JPL = re.compile(r"(?:^|_)jpl(?:_|$)")
_LEFT_HANDED = re.compile(r"(?:^|_)(?:left_?handed|unity(?:3d)?)(?:_|$)")
_STEPS = re.compile(
    r"(?:^|_)(?:(?:relative|incremental|delta|frame_to_frame)_(?:pose|transform|motion|odometry)s?)(?:_|$)"
)
_OPENGL = re.compile(r"(?:^|_)(?:open_?gl|z_backwards?|y_up)(?:_|$)")
_LENGTHS = re.compile(r"(?:^|_)(?:in_(?:mm|cm|ft|inch|inches)|(?:milli|centi|kilo)met(?:er|re)s?|feet)(?:_|$)")
_WORLD_FIRST = re.compile(r"(?:^|_)kapture_format(?:_|$)")
"""Forms that hold the pose of the world in the sensor without saying it in each name."""
_PX4 = ("timestamp_sample", "q_offset[")
"""What a header of PX4's logs has, as `ulog2csv` writes it: arrays x y z and w x y z, stamps in microseconds."""
_OTHER_PARTS = ("cov", "twist", "veloc", "accel", "gyro", "bias", "sigma", "std", "error", "imu", "mag")


_BIASES = ("bg", "b_g")
"""A gyroscope's bias, `bgx` (Kimera), which is no frame in another."""
REVERSED_MIN = 3
"""Words of a line that say so; a name or two may mean something else."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Where a row has what.

    Attributes:
        stamp: Column of the stamp, or None where a form has none.
        pose: Columns of x y z qx qy qz qw.
        unit: What the stamp is in, one of `UNITS_S`, or None where nothing says so.
        nanoseconds: Column of the nanoseconds that are added to the stamp's seconds, or None.
        metres: What one unit of the position is.
        spare: Names and columns of all others, such as `child_frame_id` or `status`.
    """

    stamp: int | None
    pose: tuple[int, ...]
    unit: str | None = None
    nanoseconds: int | None = None
    metres: float = 1.0
    spare: tuple[tuple[str, int], ...] = ()


class HeaderError(ValueError):
    """A line names columns, but not those of a trajectory; the message says why."""


def contradiction(comment: str) -> str | None:
    """What a comment or header says that makes poses something else than they would be read as; None where nothing."""
    words = re.sub(r"[^a-z0-9]+", "_", comment.lower())
    if (turned := _REVERSED_WORDS.search(words)) is not None:
        return f"the poses are said to be of the world in the body or camera ({turned[0].strip('_')}): invert them"
    if sum(_is_reversed(word) for word in re.split(r"[\s,;]+", comment)) >= REVERSED_MIN:
        return "the columns are said to be of the world in the body or camera: invert the poses"
    if _JPL.search(words):
        return "the quaternions are said to be JPL's, which turn the other way: write Hamilton's"
    if _LEFT_HANDED.search(words):
        return "the axes are said to be left-handed: write poses of right-handed ones"
    if _STEPS.search(words):
        return "the poses are said to be from one to the next: write them in one fixed frame"
    if _WORLD_FIRST.search(words):
        return "kapture's poses are of the world in the sensor: invert them"
    if (length := _LENGTHS.search(words)) is not None:
        return f"positions are said to be in another unit than metres ({length[0].strip('_')}): write them in metres"
    if _OPENGL.search(words):
        return "the axes are said to be OpenGL's (y up, z backwards): turn the poses, or give T_body_camera"
    return None


def columns_of(header: str, count: int | None = None) -> Columns | None:
    """Columns that a line names, or None where it names none (it is a comment).

    Args:
        header: The line, without its comment sign.
        count: How many fields a row has; words before that many are taken for an introduction.

    Raises:
        HeaderError: It names some, but not one column for each number of a stamped pose.
    """
    names = _names(_px4_named(header))
    has_rest = bool(names) and names[-1].startswith("*")
    names = names[:-1] if has_rest else names
    roles = [_role(name) for name in names]
    if roles.count("stamp") == 2 and any(_HEADER_STAMP.fullmatch(_bare(name)) for name in names):
        roles = [
            None if r == "stamp" and not _HEADER_STAMP.fullmatch(_bare(n)) else r
            for r, n in zip(roles, names, strict=True)
        ]
    while count is not None and len(roles) > count and roles[0] is None:
        names, roles = names[1:], roles[1:]
    if sum(role is not None for role in roles) < ROLES_MIN:
        return None
    if count is not None and (len(roles) > count if has_rest else len(roles) != count):
        raise HeaderError(f"the header names {len(roles)} columns, but rows have {count}")
    for role in (*POSE_COLUMNS, "stamp"):
        if roles.count(role) > 1:
            twice = [name for name, found in zip(names, roles, strict=True) if found == role]
            raise HeaderError(f"the header names {role!r} twice ({', '.join(twice[:3])})")
    missing = [role for role in ("stamp", *POSE_COLUMNS) if role not in roles]
    if missing:
        angles = [name for name in names if _ANGLES.fullmatch(_bare(name))]
        instead = f"; it has angles ({', '.join(angles[:3])}), whose order and axes differ" if angles else ""
        raise HeaderError(f"the header names no {', '.join(missing)}{instead}")
    turned = next((n for n, r in zip(names, roles, strict=True) if r in POSE_COLUMNS and _is_reversed(n)), None)
    if turned is not None:
        raise HeaderError(f"the header gives the pose of the world in the body or camera ({turned}): invert the poses")
    spare = tuple((_bare(name), k) for k, (name, role) in enumerate(zip(names, roles, strict=True)) if role is None)
    stamp = roles.index("stamp")
    split = roles.index("nanoseconds") if "nanoseconds" in roles else None
    unit = "seconds" if split is not None else _unit(names[stamp])
    metres = {_metres(names[roles.index(axis)]) for axis in "xyz"}
    if len(metres) > 1:
        raise HeaderError("the header gives positions in several units")
    return Columns(stamp, tuple(roles.index(role) for role in POSE_COLUMNS), unit, split, metres.pop(), spare)


def names_columns(header: str) -> bool:
    """Whether a line names columns of a trajectory, well or badly."""
    return sum(_role(name) is not None for name in _names(_px4_named(header))) >= ROLES_MIN


def begins_with_stamp(header: str) -> bool:
    """Whether the first word of a line is what a column of stamps is called."""
    names = _names(header)
    return bool(names) and _role(names[0]) == "stamp"


def _px4_named(header: str) -> str:
    """A header of PX4's logs with names for the elements of its arrays, and any other header as it is."""
    if not any(sign in header for sign in _PX4):
        return header
    named = re.sub(r"\bposition\[([0-2])\]", lambda found: "position_" + "xyz"[int(found[1])], header)
    named = re.sub(r"\bq\[([0-3])\]", lambda found: "q_" + "wxyz"[int(found[1])], named)
    if re.search(r"\btimestamp_sample\b", named):  # when it was measured; `timestamp` is when it was published
        named = re.sub(r"\btimestamp\b(?!_)", "published", named)
        return re.sub(r"\btimestamp_sample\b", "timestamp[us]", named)
    return re.sub(r"\btimestamp\b(?!_)", "timestamp[us]", named)


def _is_reversed(name: str) -> bool:
    frames = re.sub(r"_?[xyzw]$", "", re.split(r"[./]", _bare(name))[-1])
    return frames not in _BIASES and _REVERSED.search(frames) is not None


def _metres(name: str) -> float:
    """What one unit of a position is, by what stands in brackets behind its name."""
    bracketed = re.search(r"[\[(](.*?)[\])]", name)
    unit = bracketed[1].strip().lower() if bracketed else _length_unit(_bare(name)) or "m"
    if unit not in _METRES:
        raise HeaderError(f"the header gives positions in {unit!r}, not in metres")
    return _METRES[unit]


def _length_unit(bare: str) -> str | None:
    """The unit in which a name ends, as `tx_mm` does."""
    stem, _, last = bare.rpartition("_")
    return last if stem and last in _METRES else None


def _names(header: str) -> list[str]:
    expanded = _ORDER.sub(r"q\2 q\3 q\4 q\5", header)
    separated = re.sub(r"\s*([\[(][^\])]*[\])])", lambda found: found[1].replace(" ", "").replace(",", "·"), expanded)
    splitter = r"[;,]" if len(re.findall(r"[;,]", separated)) >= len(POSE_COLUMNS) - 1 else r"[\s;,]+"
    names = [name.strip(" \t\"'") for name in re.split(splitter, separated)]
    while names and not names[-1]:
        names.pop()
    return names


def _bare(name: str) -> str:
    """A name without its unit, in lower case; inner spaces are underscores."""
    return re.sub(r"[\[(].*?[\])]", "", name).strip(" _.:#%").lower().replace(" ", "_")


def _role(name: str) -> str | None:
    bare = _bare(name)
    if any(part in bare for part in _OTHER_PARTS):
        return None
    if bare in ("nsec", "nsecs", "nanosec", "nanosecs", "stamp.nanosec", "header.stamp.nanosec", "header.stamp.nsecs"):
        return "nanoseconds"
    if bare in ("sec", "secs", "seconds", "stamp.sec", "header.stamp.sec", "header.stamp.secs"):
        return "stamp"
    if _STAMP.fullmatch(_without_unit(bare)):
        return "stamp"
    if (unit := _length_unit(bare)) is not None:
        bare = bare.removesuffix(f"_{unit}")
    found = re.fullmatch(r"(?P<group>.*?)[_./]?(?P<axis>[xyzw])", bare)
    if found is None:
        return None
    if _QUATERNION.fullmatch(found["group"]):
        return "q" + found["axis"]
    is_position = _POSITION.fullmatch(found["group"]) and found["axis"] != "w"
    return found["axis"] if is_position else None


def _without_unit(bare: str) -> str:
    stem, _, last = bare.rpartition("_")
    return stem if stem and last in _UNIT_OF else bare


def _unit(name: str) -> str | None:
    if _HEADER_STAMP.fullmatch(_bare(name)):
        return "nanoseconds"  # as rostopic echo -p writes it
    bracketed = re.search(r"[\[(](.*?)[\])]", name)
    words = [bracketed[1].strip().lower()] if bracketed else []
    words.append(_bare(name).rpartition("_")[2])
    if (other := next((word for word in words if word in _OTHER_UNITS), None)) is not None:
        raise HeaderError(f"the header gives stamps in {other!r}: write them in seconds")
    return next((_UNIT_OF[word] for word in words if word in _UNIT_OF), None)
