"""A long job says how far it is where nobody looks at a terminal."""

import pytest

from flocc_launch.commands.common import ProgressLines


def test_a_job_of_two_minutes_says_a_line_every_fifteen_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = 100.0
    lines = ProgressLines("preparing data", "picture", lambda: now_s)
    for done in range(61):
        lines.tell(done, 60)
        now_s += 1.0
    assert capsys.readouterr().err.splitlines() == [
        "preparing data: picture 15 of 60, about 45 s left",
        "preparing data: picture 30 of 60, about 30 s left",
        "preparing data: picture 45 of 60, about 15 s left",
        "preparing data: picture 60 of 60, about 0 s left",
    ]


def test_a_slow_start_does_not_make_the_estimate_long(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = 0.0
    lines = ProgressLines("preparing data", "picture", lambda: now_s)
    for done in range(1, 31):
        now_s += 40.0 if done == 1 else 1.0
        lines.tell(done, 60)
    assert capsys.readouterr().err.splitlines() == [
        "preparing data: picture 2 of 60, about 58 s left",
        "preparing data: picture 17 of 60, about 43 s left",
    ]


def test_the_next_robots_pictures_are_counted_anew(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = 0.0
    lines = ProgressLines("preparing data", "picture", lambda: now_s)
    for _ in range(2):
        now_s += 20.0  # the pictures are held against the trajectory first
        for done in range(1, 11):
            lines.tell(done, 10)
            now_s += 1.0
    assert capsys.readouterr().err.splitlines() == [
        "preparing data: picture 2 of 10, about 8 s left",
        "preparing data: picture 2 of 10, about 8 s left",
    ]


def test_a_short_job_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = 0.0
    lines = ProgressLines("preparing data", "picture", lambda: now_s)
    for done in range(100):
        lines.tell(done, 100)
        now_s += 0.1
    assert capsys.readouterr().err == ""
