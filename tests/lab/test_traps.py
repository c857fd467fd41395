"""Kinds of input that were once read wrongly without a word are read rightly or refused: one draw of each."""

from pathlib import Path

import numpy as np
import pytest

from flocc_lab.dialects.traps import TRAPS, judged


@pytest.mark.parametrize("kind", TRAPS)
def test_a_trap_is_read_rightly_or_refused(kind: str, tmp_path: Path) -> None:
    verdict = judged(kind, np.random.default_rng(7), tmp_path)
    assert verdict.good, verdict
