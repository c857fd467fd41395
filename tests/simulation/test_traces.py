"""Stories of a swarm, as text: `traces/*.txt`."""

from pathlib import Path

import pytest

from flocc_lab.traces import TraceError, played

TRACES = sorted((Path(__file__).parent / "traces").glob("*.txt"))


@pytest.mark.parametrize("path", TRACES, ids=lambda path: path.stem)
def test_the_story_is_as_written(path: Path, request: pytest.FixtureRequest) -> None:
    text = path.read_text(encoding="utf-8")
    happened = played(text)
    if request.config.getoption("--rewrite", default=False):
        path.write_text(happened, encoding="utf-8")
        return
    assert happened == text


def test_a_trace_says_which_command_it_does_not_know() -> None:
    with pytest.raises(TraceError, match="'dance'"):
        played("robots r1\n\ndance\n")


def test_there_is_a_trace_for_every_story() -> None:
    assert len(TRACES) >= 12
