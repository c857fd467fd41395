"""The recipes of CONTRIBUTING.md, done: what they insert goes into a copy of the packages, and is used there."""

import json
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from tests.agent.perception.plugin_folder import install

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.core.registration import RegistrationFailed
from flocc_agent.perception.backends import build_perception
from flocc_protocol.records import UnknownRecord, decode_record

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
STEP = re.compile(
    r"(?:In `(?P<file>[\w/.]+)`, (?P<where>before|after) `(?P<anchor>[^`]+)`|New file `(?P<new>[\w/.]+)`):\n\n"
    r"(?P<indent> *)```python\n(?P<code>.*?)\n(?P=indent)```",
    re.DOTALL,
)
RECORD = """
import sys
from flocc_agent.core.factors import factor_of
from flocc_agent.core.measurements import BadMeasurement, Height
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import HeightRecord, decode_record, encode_record

record = Height(12.5, 0.3).in_camera(None).record(KeyframeId(LogId("r1"), 4))
assert decode_record(encode_record(record)) == record == HeightRecord(4, 12.5, 0.3)
factor = factor_of(LogId("r1"), record, {})
assert (factor.kind, factor.T_query_match[2, 3], round(factor.covariance[2, 2], 4)) == ("height", 12.5, 0.09)
try:
    Height(12.5, -1.0)
except BadMeasurement:
    sys.stdout.write(encode_record(record).hex())
"""
MESSAGE = """
import sys
from flocc_agent.core.effects import Report
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.reports import PeerPauses
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.zenoh_transport import PRIORITY
from flocc_protocol.ids import LogId
from flocc_protocol.keys import Kind
from flocc_protocol.messages import MESSAGE_KINDS, Envelope, decode, encode
from flocc_protocol.pauses import Pause

envelope = Envelope(LogId("r2"), Pause(3.0))
assert decode(encode(envelope)) == envelope
assert set(PRIORITY) == set(MESSAGE_KINDS) == {kind.value for kind in Kind}
effects = Robot(LogId("r1"), 0, 1, CoreParameters(), 0.0).handle(MessageReceived(envelope), 1.0)
assert Report(PeerPauses(peer="r2", seconds=3.0)) in effects
sys.stdout.write("done")
"""

REPORT = """
import json, sys
from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.parameters import RoundParameters
from flocc_agent.core.reports import RoundsFailing
from flocc_agent.core.rounds import Rounds
from flocc_agent.runtime.event_lines import Reported, line_of, reported_of
from flocc_protocol.ids import LogId, Term
from flocc_protocol.records import KeyframeRecord

assembly, term = GraphAssembly(), Term(3, LogId("r1"))
assembly.add(NewRecord(LogId("r1"), 0, KeyframeRecord(0, 0.0, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None)))
rounds = Rounds(assembly, RoundParameters())
rounds.on_term(term)
rounds.tick(0.0)
told = [effect.fact for effect in rounds.tick(rounds.deadline())]
assert told[1] == RoundsFailing(term=term, failures=1)
line = json.dumps(line_of(Reported(7.5, "r1", told[1])))
assert reported_of(line) == Reported(7.5, "r1", told[1])
sys.stdout.write(line)
"""


def recipe(title: str) -> str:
    """The part of the page below a heading."""
    return PAGE.split(f"### {title}\n")[1].split("\n### ")[0].split("\n## ")[0]


def follow(title: str, folder: Path) -> list[str]:
    """Do the steps of a recipe in a copy of the packages, and give the files that they touch."""
    for package in ("protocol/flocc_protocol", "agent/flocc_agent"):
        if not (folder / package).exists():
            shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__", "*.npz"))
    touched = []
    for step in STEP.finditer(recipe(title)):
        code = textwrap.dedent(step["code"])
        path = folder / (step["new"] or step["file"])
        touched.append(str(path.relative_to(folder)))
        if step["new"]:
            path.write_text(code + "\n", encoding="utf-8")
        else:
            insert(path, step["where"], step["anchor"], code)
    return sorted(set(touched))


def insert(path: Path, where: str, anchor: str, code: str) -> None:
    """Put code beside the only line that is the anchor, as far to the right as that one."""
    lines = path.read_text(encoding="utf-8").splitlines()
    (at,) = [k for k, line in enumerate(lines) if line.strip() == anchor]
    added = textwrap.indent(code, " " * (len(lines[at]) - len(lines[at].lstrip()))).splitlines()
    at += where == "after"
    path.write_text("\n".join([*lines[:at], *added, *lines[at:]]) + "\n", encoding="utf-8")


def run_there(folder: Path, program: str) -> str:
    """Run a program with the packages of the copy."""
    search = f"import sys; sys.path[:0] = [{str(folder / 'protocol')!r}, {str(folder / 'agent')!r}]\n"
    command = [sys.executable, "-c", search + program]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, cwd=folder)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_a_record_is_added_as_the_recipe_says(tmp_path: Path) -> None:
    files = follow("Add a record", tmp_path)
    assert len(files) <= 4
    written = bytes.fromhex(run_there(tmp_path, RECORD))
    assert decode_record(written) == UnknownRecord(14, written), "an earlier version keeps it"


def test_a_message_is_added_as_the_recipe_says(tmp_path: Path) -> None:
    assert "protocol/flocc_protocol/pauses.py" in follow("Add a message", tmp_path)
    assert run_there(tmp_path, MESSAGE) == "done"


def test_a_report_touches_two_files_as_the_recipe_says(tmp_path: Path) -> None:
    files = follow("Add a report", tmp_path)
    assert files == ["agent/flocc_agent/core/reports.py", "agent/flocc_agent/core/rounds.py"]
    line = json.loads(run_there(tmp_path, REPORT))
    assert line == {"t": 7.5, "robot": "r1", "event": "rounds_failing", "term": "3:r1", "failures": 1}


def test_the_front_end_of_the_recipe_is_chosen_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", recipe("Add a front end"), re.DOTALL)
    (entry,) = re.findall(r'"flocc.perception"\]\n\s*(\w+) = "([\w:]+)"', recipe("Add a front end"))
    (tmp_path / "grey_eyes.py").write_text(code, encoding="utf-8")
    install(tmp_path, *entry)
    monkeypatch.syspath_prepend(tmp_path)
    perception = build_perception(PerceptionConfig(method="grey"))
    camera = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    image = Image(np.full((48, 64, 3), 90, np.uint8), camera)
    descriptor = perception.describer.describe(image)
    assert descriptor.shape == (perception.describer.dimension,)
    assert np.linalg.norm(descriptor) == pytest.approx(1.0)
    latent = perception.encode(image)
    assert isinstance(perception.register(latent, latent, None), RegistrationFailed)


@pytest.mark.parametrize("title", ["Add a record", "Add a message", "Add a report"])
def test_every_block_of_a_recipe_is_a_step(title: str) -> None:
    assert recipe(title).count("```python") == len(list(STEP.finditer(recipe(title)))) >= 3
