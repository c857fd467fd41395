"""What the command line says to a slip of the keyboard, and of itself."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from flocc_launch.commands.main import main
from flocc_protocol.messages import PROTOCOL_VERSION


def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    """Exit code of `flocc WORDS`, and everything that it printed, on one line."""
    monkeypatch.setattr(sys, "argv", ["flocc", *words])
    with pytest.raises(SystemExit) as left:
        main()
    out, err = capsys.readouterr()
    assert isinstance(left.value.code, int)
    return left.value.code, " ".join((out + err).split())


def test_the_version_is_that_of_the_distribution_and_the_wire(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said(monkeypatch, capsys, "--version") == (0, f"flocc {version('flocc')} (protocol {PROTOCOL_VERSION})")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_can_be_had(shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    code, text = said(monkeypatch, capsys, "--show-completion", shell)
    assert code == 0
    assert "flocc" in text
    assert "_FLOCC_COMPLETE" in text


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ('nmae = "x"\n', "the key 'nmae' does not exist; did you mean 'name'?"),
        ('name = "x"\n[tracks]\nrobts = 3\n', "the key 'tracks.robts' does not exist; did you mean 'robots'?"),
        ('name = "x"\n[tracks]\nzzz = 3\n', "the key 'tracks.zzz' does not exist"),
        ('name = "x"\n[radoi]\n', "the key 'radoi' does not exist; did you mean 'radio'?"),
    ],
)
def test_a_misspelt_key_is_answered_with_the_nearest(
    text: str, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    assert said(monkeypatch, capsys, "simulate", str(path)) == (2, f"error: {path}: {wanted}")


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (("simulate", "meeting", "--loss", "30"), "'--loss'"),
        (("simulate", "meeting", "--duration", "0"), "'--duration'"),
        (("launch", "meeting", "--latency", "-1"), "'--latency'"),
        (("simulate", "meeting", "--los", "0.3"), "--loss"),
        (("simlate",), "simulate"),
    ],
)
def test_a_bad_option_is_named_and_so_is_what_was_meant(
    words: tuple[str, ...], wanted: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text = said(monkeypatch, capsys, *words)
    assert code == 2
    assert wanted in text


def test_a_reader_that_leaves_is_no_missed_expectation() -> None:
    """As `flocc --version | true`, but with a reader that has surely left."""
    read, write = os.pipe()
    os.close(read)
    try:
        command = [sys.executable, "-m", "flocc_launch.commands.main", "--version"]
        ran = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(write)
    assert (ran.returncode, ran.stderr) == (141, "")
