"""The pages as a site: all of them, in an order, searchable, no broken link, nothing fetched from elsewhere."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from tests.doc_commands import ROOT
from tests.test_docs import PAGES

from flocc_lab.reference.site_pages import gather, pages, rewritten


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; strict, so that a broken link or a page that the order leaves out ends the build."""
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("material") is None:
        pytest.skip("mkdocs-material is not installed (extra docs)")
    place = tmp_path_factory.mktemp("site")
    gather(place / "pages")
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    settings = settings.replace("build/pages", str(place / "pages")).replace("build/site", str(place / "site"))
    (place / "mkdocs.yml").write_text(settings, encoding="utf-8")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", str(place / "mkdocs.yml")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=200)
    assert built.returncode == 0, built.stdout + built.stderr
    return place / "site"


def test_every_page_is_on_the_site() -> None:
    assert {page for page in PAGES if page not in pages()} == set()


def named_in(nav: object) -> list[str]:
    """Pages that the order names."""
    if isinstance(nav, str):
        return [nav]
    inside = nav.values() if isinstance(nav, dict) else nav if isinstance(nav, list) else []
    return [name for each in inside for name in named_in(each)]


def test_the_order_has_every_page_once() -> None:
    settings = YAML(typ="safe", pure=True).load(ROOT / "mkdocs.yml")
    assert sorted(named_in(settings["nav"])) == sorted(pages().values())
    assert named_in(settings["nav"])[:2] == ["index.md", "quick-start.md"]


@pytest.mark.slow
def test_the_site_is_built_and_can_be_searched(site: Path) -> None:
    index = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))
    found = {entry["location"].split("#")[0] for entry in index["docs"] if "weak-link" in entry["text"]}
    assert "doctor.html" in found
    assert {name.replace(".md", ".html") for name in pages().values()} <= {path.name for path in site.glob("*.html")}


@pytest.mark.slow
def test_the_site_fetches_nothing_from_elsewhere(site: Path) -> None:
    for page in site.glob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert re.findall(r"<(?:script|img|iframe)[^>]+src=\"?https?:", text) == []
        assert re.findall(r"<link[^>]+rel=\"?stylesheet[^>]+href=\"?https?:", text) == []


def test_links_lead_to_pages_of_the_site_and_code_stays_as_it_is() -> None:
    text = "[a](../README.md#x) ![b](images/r.png) [c](../Makefile) [d](https://x.y)\n```\n[e](../README.md)\n```\n[f](gone.md)"
    assert rewritten(text, ROOT / "docs/report.md", pages(), ROOT) == (
        "[a](index.md#x) ![b](images/r.png) c (`Makefile`) [d](https://x.y)\n```\n[e](../README.md)\n```\n[f](gone.md)"
    )


def test_a_picture_beside_the_text_stands_behind_it_on_the_site() -> None:
    picture = '<img align="right" width="420" src="docs/images/report.png" alt="x">'
    text = f'# flocc\n\n{picture}\n\nWords.\n\n<br clear="right">\n\nMore.'
    wanted = '# flocc\n\nWords.\n\n<img src="images/report.png" alt="x">\n\nMore.'
    assert rewritten(text, ROOT / "README.md", pages(), ROOT) == wanted
