"""Draws trajectories and names of images in every form, and sees what the readers make of them.

A file that says what it holds must give what was drawn, whatever its encoding, separators and line ends; one that does
not may be refused, and must never give anything else.

    python -m flocc_lab.dialects.trajectories --count 500 --seed 1
"""

import argparse
import json
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_lab.dialects.trajectory_writers import (
    AMBIGUOUS_NAMES,
    FORMS,
    NAMES,
    NUMBERS,
    Row,
    line,
    rows_of,
    wxyz,
    xyzw,
)
from flocc_launch.datasets.stamped_names import stamps_of_names
from flocc_protocol.errors import FloccError

POSES = (8, 120)
SURFACES = ("as it is", "BOM", "UTF-16", "CRLF", "old Mac", "tabs", "semicolons", "decimal commas", "comments", "blank")
UNITLESS = ("OKVIS", "LaMAR", "ZED", "Kimera")
"""Forms whose header names no unit: stamps say it themselves where they count from 1970."""
FAULTS = ("nan", "word", "short", "zero quaternion", "duplicate", "step back")


@dataclass(frozen=True, slots=True)
class FileVerdict:
    """What became of one file.

    Attributes:
        form: Name of the form, with how it was changed.
        must_read: Whether the file says all that is needed.
        outcome: "right", "refused" or "wrong".
        detail: What the reader said, or gave.
    """

    form: str
    must_read: bool
    outcome: str
    detail: str

    @property
    def good(self) -> bool:
        """Whether it is what it has to be."""
        return self.outcome == "right" or (self.outcome == "refused" and not self.must_read)


def drawn_trajectory(rng: np.random.Generator) -> Trajectory:
    """A body that drives on a plane, flies, or is carried about, from any start at any time."""
    count = int(rng.integers(*POSES))
    zero_s = float(rng.choice([0.0, 512.0, 1_400_000_000.0, 1_700_000_000.0]))
    step_s = float(rng.choice([0.005, 0.05, 0.1, 0.5]))
    kind = rng.choice(["planar", "flying", "carried"])
    T = pose(so3_exp(rng.uniform(-2, 2, 3)) if kind != "planar" else np.eye(3), rng.uniform(-50, 50, 3))
    poses = []
    for _ in range(count):
        poses.append(T)
        turn = rng.normal(0, 0.1, 3) * (np.array([0, 0, 1]) if kind == "planar" else 1.0)
        go = np.array([0.2, 0, 0]) if kind == "planar" else rng.normal(0, 0.1, 3)
        T = T @ pose(so3_exp(turn), go)
    return Trajectory(np.round(zero_s + step_s * np.arange(count), 6), np.array(poses))


def surfaced(text: str, surface: str, commas: bool) -> bytes:
    """A text as another program or system would store it; `commas` says that it has them between columns."""
    match surface:
        case "BOM":
            return b"\xef\xbb\xbf" + text.encode()
        case "UTF-16":
            return text.encode("utf-16")
        case "CRLF":
            return text.replace("\n", "\r\n").encode()
        case "old Mac":
            return text.replace("\n", "\r").encode()
        case "tabs" if not commas:
            return text.replace(" ", "\t").encode()
        case "semicolons" if not commas:
            return text.replace(" ", ";").encode()
        case "semicolons":
            return text.replace(",", ";").encode()
        case "decimal commas" if not commas:
            return text.replace(".", ",").encode()
        case "comments":
            return b"# made by hand, Zu\xcc\x88rich\n# second line\n" + text.encode()
        case "blank":
            return text.replace("\n", "\n\n").encode()
    return text.encode()


def faulty(rows: list[Row], fault: str, rng: np.random.Generator) -> tuple[list[str | Row], list[int]]:
    """Rows with a few that are damaged, and the numbers of those that are good."""
    spoilt = sorted({2 * int(k) + 1 for k in rng.integers(0, len(rows) // 2, max(1, len(rows) // 12))})
    out: list[str | Row] = list(rows)
    for k in spoilt:
        stamp_s = rows[k][0]
        values: list[float | int | str] = [stamp_s, *xyzw(rows[k])]
        if fault == "nan":
            values[2] = float("nan")
        elif fault == "word":
            values[5] = "lost"
        elif fault == "short":
            values = values[:4]
        elif fault == "zero quaternion":
            values[4:8] = [0.0] * 4
        elif fault == "step back":
            values[0] = rows[0][0] - 1.0
        else:
            values[0] = rows[k - 1][0]
        out[k] = line(values)
    return out, [k for k in range(len(rows)) if k not in spoilt]


def judge_trajectory(rng: np.random.Generator, folder: Path) -> FileVerdict:
    """Draw a file, write it and read it."""
    truth = drawn_trajectory(rng)
    rows = rows_of(truth)
    which = rng.choice(["form", "free", "faulty"], p=[0.5, 0.3, 0.2])
    surface = str(rng.choice(SURFACES))
    kept = list(range(len(rows)))
    if which == "form":
        name = str(rng.choice(list(FORMS)))
        form = FORMS[name]
        if form.how == "columns" and truth.stamps_s[0] < 1e9:
            truth = Trajectory(truth.stamps_s + 1.5e9, truth.T_fixed_body)
            rows = rows_of(truth)
        text, file, must_read = form.write(rows), form.file, form.how in ("header", "suffix", "columns")
        must_read = must_read and (name not in UNITLESS or truth.stamps_s[0] > 1e9)
    elif which == "free":
        name, text, must_read = free_form(rows, rng)
        file = "free.txt"
    else:
        name = str(rng.choice(FAULTS))
        written, kept = faulty(rows, name, rng)
        text = "".join(each if isinstance(each, str) else line([each[0], *xyzw(each)]) for each in written)
        file, must_read = "odometry.tum", True
    path = folder / file
    path.write_bytes(surfaced(text, surface, "," in text))
    return _judged(
        f"{which}: {name}, {surface}", must_read, path, Trajectory(truth.stamps_s[kept], truth.T_fixed_body[kept])
    )


def free_form(rows: list[Row], rng: np.random.Generator) -> tuple[str, str, bool]:
    """A table as somebody would write it: any order, unit, separator, with or without a header."""
    is_wxyz, separator = bool(rng.integers(2)), str(rng.choice([" ", ",", "\t", ", "]))
    header = str(rng.choice(["none", "unit", "full"]))
    unit = str(rng.choice(["s", "ms", "us", "ns", *(["min", "h"] if header != "none" else [])]))
    per_s = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9, "min": 1 / 60, "h": 1 / 3600}[unit]
    q = "qw qx qy qz" if is_wxyz else "qx qy qz qw"
    names = {"unit": f"time[{unit}] x y z {q}", "full": f"timestamp_{unit} p_x p_y p_z {q.replace('q', 'q_')}"}
    mark = str(rng.choice(["# ", ""]))
    head = "" if header == "none" else mark + separator.join(names[header].split()) + "\n"
    text = head + "".join(
        line([r[0] * per_s if per_s <= 1 else round(r[0] * per_s), *(wxyz(r) if is_wxyz else xyzw(r))], separator)
        for r in rows
    )
    said = header != "none" and per_s >= 1
    return f"{'wxyz' if is_wxyz else 'xyzw'} in {unit}, header {header}", text, said


def _judged(name: str, must_read: bool, path: Path, truth: Trajectory) -> FileVerdict:
    try:
        found, _ = read_trajectory(path)
    except FloccError as error:
        return FileVerdict(name, must_read, "refused", str(error))
    if len(found) != len(truth):
        return FileVerdict(name, must_read, "wrong", f"{len(found)} poses, not {len(truth)}")
    off_s = float(np.max(np.abs(found.stamps_s - truth.stamps_s)))
    off = float(np.max(np.abs(found.T_fixed_body - truth.T_fixed_body)))
    is_right = off_s < 1e-3 and off < 1e-5
    return FileVerdict(name, must_read, "right" if is_right else "wrong", f"off by {off_s:g} s and {off:g}")


def judge_names(rng: np.random.Generator) -> FileVerdict:
    """Draw names of images, and read their stamps."""
    count, zero_s = int(rng.integers(2, 60)), 1_700_000_000.0 + float(rng.integers(10**6))
    stamps_s = [zero_s + round(0.1 * k + 0.003 * float(rng.random()), 3) for k in range(count)]
    which = rng.choice(["stamps", "numbers", "ambiguous"], p=[0.7, 0.2, 0.1])
    counting = NUMBERS if which == "numbers" else AMBIGUOUS_NAMES
    exact = NAMES if which == "stamps" else {name: (form, 0.0) for name, form in counting.items()}
    name = str(rng.choice(list(exact)))
    write, exact_s = exact[name]
    label, must_read = f"names: {name}", which != "ambiguous"
    try:
        found, _ = stamps_of_names([write(s, k) for k, s in enumerate(stamps_s)], "images")
    except FloccError as error:
        return FileVerdict(label, must_read, "refused", str(error))
    if found is None or which != "stamps":
        is_right = found is None and which == "numbers"
        return FileVerdict(
            label, must_read, "right" if is_right else "wrong", "numbers" if found is None else str(found[:2])
        )
    off_s = float(np.max(np.abs(np.array(found) - stamps_s)))
    return FileVerdict(label, must_read, "right" if off_s <= 2 * exact_s else "wrong", f"off by {off_s:g} s")


def campaign(count: int, seed: int, folder: Path) -> list[FileVerdict]:
    """Verdicts on as many drawn files; two in five are names."""
    rng = np.random.default_rng(seed)
    return [judge_names(rng) if rng.random() < 0.4 else judge_trajectory(rng, folder) for _ in range(count)]


def main() -> None:
    """Print how many were right, refused and wrong, and the wrong ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="flocc-dialects-") as folder:
        verdicts = campaign(given.count, given.seed, Path(folder))
    outcomes = Counter(verdict.outcome for verdict in verdicts)
    bad = [f"{verdict.form}: {verdict.outcome}: {verdict.detail}" for verdict in verdicts if not verdict.good]
    sys.stdout.write(
        json.dumps({"files": given.count, **outcomes, "bad": len(bad), "which": bad[:40]}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
