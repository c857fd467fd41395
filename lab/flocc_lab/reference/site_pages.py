"""Gather all pages for the site: `python -m flocc_lab.reference.site_pages build/pages`, part of `make docs`.

Pages lie where a reader of the repository looks for them, the site wants them in one folder. Links between pages are
rewritten; a link to a file that is no page becomes its name.
"""

import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[3]
ELSEWHERE = {
    "README.md": "index.md",
    "docs/README.md": "pages.md",
    "agent/README.md": "agent.md",
    "protocol/README.md": "protocol.md",
    "docker/README.md": "containers.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Pages whose place in the site is not that in `docs/`."""
LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<path>[^)#\s]+)(?P<anchor>#[^)]*)?\)")
PICTURE = re.compile(r"(?P<before>!\[[^\]]*\]\(|<img [^>]*src=\")(?P<path>[^)\"]+)")
BESIDE = re.compile(r'<img align="right" width="\d+"(?P<rest>[^>]*>)\n*(?P<text>.*?)<br clear="right">\n?', re.S)
"""A picture beside the text: the site's columns have no room for that, so there it stands behind the text."""
FENCE = re.compile(r"^```.*?^```", re.M | re.S)


def pages(root: Path = ROOT) -> dict[Path, str]:
    """Every page of the repository and its name in the site."""
    inside = {path: path.name for path in sorted(root.glob("docs/*.md")) if path.name != "README.md"}
    return inside | {root / path: name for path, name in ELSEWHERE.items()}


def gather(out: Path, root: Path = ROOT) -> list[str]:
    """Write all pages and their pictures into a folder that is made anew; gives the pages' names."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    shutil.copytree(root / "docs/images", out / "images")
    names = pages(root)
    for path, name in names.items():
        (out / name).write_text(rewritten(path.read_text(encoding="utf-8"), path, names, root), encoding="utf-8")
    return sorted(names.values())


def rewritten(text: str, page: Path, names: dict[Path, str], root: Path) -> str:
    """A page's text with links as the site has them; blocks of code stay as they are."""
    alone = BESIDE.sub(lambda found: f"{found['text']}<img{found['rest']}\n", text)
    return "".join(part if is_code else _linked(part, page, names, root) for part, is_code in pieces(alone))


def pieces(text: str) -> Iterator[tuple[str, bool]]:
    """Parts of a page, and whether each is a fenced block."""
    at = 0
    for fence in FENCE.finditer(text):
        yield text[at : fence.start()], False
        yield fence[0], True
        at = fence.end()
    yield text[at:], False


def _linked(text: str, page: Path, names: dict[Path, str], root: Path) -> str:
    def link(found: re.Match[str]) -> str:
        if "://" in found["path"]:
            return found[0]
        target = Path(os.path.normpath(page.parent / found["path"]))
        if target in names:
            return f"[{found['text']}]({names[target]}{found['anchor'] or ''})"
        return f"{found['text']} (`{target.relative_to(root)}`)" if target.exists() else found[0]

    def picture(found: re.Match[str]) -> str:
        target = Path(os.path.normpath(page.parent / found["path"]))
        inside = target.is_relative_to(root / "docs")
        return f"{found['before']}{target.relative_to(root / 'docs')}" if inside else found[0]

    return PICTURE.sub(picture, LINK.sub(link, text))


if __name__ == "__main__":
    gather(Path(sys.argv[1]))
