"""A front end is a name: flocc's own, or what an installed package brings."""

import sys
from pathlib import Path

import pytest
from tests.agent.perception.plugin_folder import install

from flocc_agent.config import PerceptionConfig
from flocc_agent.perception.backends import PerceptionError, build_perception, check_perception, methods

STRANGER = """
from flocc_agent.core.interfaces import Perception

class Eyes:
    dimension, model = 4, "stranger-1"

def build(config, seed):
    return Perception(Eyes(), Eyes(), (config.options, seed))
"""


def brought(folder: Path, monkeypatch: pytest.MonkeyPatch, source: str, name: str = "stranger") -> None:
    """Put a package with one module on this process's path."""
    module = folder.name.replace("-", "_") + "_eyes"
    (folder / f"{module}.py").write_text(source)
    install(folder, name, f"{module}:build")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, module, raising=False)


def test_flocc_brings_its_own() -> None:
    assert {name: package for name, package in methods().items() if package == "flocc"}.keys() == {
        "classical",
        "learned",
        "synthetic",
        "recorded",
        "mast3r",
    }
    assert build_perception(PerceptionConfig(method="classical")).encoder.model.startswith("classical/")


def test_an_unknown_name_is_answered_with_those_that_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    brought(tmp_path, monkeypatch, STRANGER)
    with pytest.raises(PerceptionError) as caught:
        check_perception(PerceptionConfig(method="sonar"))
    assert str(caught.value) == (
        "perception.method 'sonar' is unknown; flocc's own are classical, learned, synthetic, recorded, mast3r; "
        "installed packages bring stranger (of plugin 1.0)"
    )


def test_an_installed_package_is_built_with_its_options_and_the_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    brought(tmp_path, monkeypatch, STRANGER)
    config = PerceptionConfig(method="stranger", options={"depth_m": 3})
    check_perception(config)
    built = build_perception(config, seed=7)
    assert built.encoder.model == "stranger-1"
    assert built.registrar == ({"depth_m": 3}, 7)  # type: ignore[comparison-overlap]


def test_no_package_takes_a_name_of_flocc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    brought(tmp_path, monkeypatch, STRANGER, name="classical")
    assert build_perception(PerceptionConfig()).encoder.model.startswith("classical/")
    assert methods()["classical"] == "flocc"


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("import nowhere_to_be_found", "cannot be built: No module named 'nowhere_to_be_found'"),
        ("def build(config, seed): raise ValueError('no weights')", "cannot be built: no weights"),
        ("def build(config, seed): return {}['weights']", "cannot be built: 'weights'"),
        ("def build(config, seed): return 1 / 0", "cannot be built: division by zero"),
        ("def build(config, seed): raise AssertionError", "cannot be built: AssertionError"),
        ("def build(config, seed): return 3", "gives a int, not a flocc_agent.core.interfaces.Perception"),
    ],
)
def test_a_package_that_fails_is_named_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, sentence: str
) -> None:
    brought(tmp_path, monkeypatch, source)
    with pytest.raises(PerceptionError, match=r"perception 'stranger' of plugin 1\.0 \(\w+:build\) ") as caught:
        build_perception(PerceptionConfig(method="stranger"))
    assert str(caught.value).endswith(sentence)
