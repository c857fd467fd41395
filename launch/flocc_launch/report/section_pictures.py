"""Pictures in the report: pairs with the matches drawn, each opened by a click on the map, and views along the way.

No script: a pair is a sheet that shows while the page's fragment names it. Every picture stands in the page once.
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from itertools import groupby

from flocc_launch.report.album import Album, Drawn, Picture
from flocc_launch.report.figure_map import colour
from flocc_launch.report.model import RunReport
from flocc_launch.report.shown_pairs import Fate, ShownPair, anchor
from flocc_launch.report.svg import element, text_of
from flocc_launch.runs.plain_numbers import count_of, number
from flocc_protocol.ids import KeyframeId

GAP_PX = 8


def way_strips(report: RunReport, album: Album) -> str:
    """What each robot saw along its way, numbered as on the map."""
    if not album.views:
        return ""
    rows = []
    for robot, group in groupby(album.views.items(), key=lambda item: item[0].log.robot):
        pictures = [view_box(keyframe, picture, k) for k, (keyframe, picture) in enumerate(group, start=1)]
        rows.append(element("div", *pictures, class_=f"strip {colour(report.robots, robot)}"))
    return element("h3", "What they saw on the way") + "".join(rows)


def view_box(keyframe: KeyframeId, picture: Picture, number_of: int) -> str:
    """One picture of a strip."""
    drawing = element(
        "svg",
        image(picture),
        viewBox=f"0 0 {picture.width_px} {picture.height_px}",
        role="img",
        aria_label=f"picture of {keyframe}",
    )
    label = f"{keyframe.log.robot} {number_of}"
    return element(
        "figure", drawing, element("figcaption", element("b", text_of(label)), f" {keyframe.index}"),
        id=f"view-{anchor(keyframe)}",
    )  # fmt: skip


def picture_store(album: Album) -> str:
    """The pictures of all pairs, each once, for `use`."""
    if not album.pictures:
        return ""
    images = [image(picture, f"seen-{anchor(keyframe)}") for keyframe, picture in sorted(album.pictures.items())]
    return element("svg", element("defs", *images), class_="store", aria_hidden="true")


def image(picture: Picture, id_: str | None = None) -> str:
    """A picture as an SVG image at the origin."""
    data = f"data:image/jpeg;base64,{b64encode(picture.jpeg).decode()}"
    return element("image", id=id_, width=picture.width_px, height=picture.height_px, href=data)


def gallery(album: Album) -> str:
    """Small pictures of all pairs by what became of them; each opens its sheet."""
    if not album.pairs:
        return ""
    parts = [element("h3", "Pictures", id="pictures"), picture_store(album)]
    if any(each.right is False for each in album.pairs):
        parts.append(element("p", "The wrong ones first: look for what repeats, and for what moves.", class_="note"))
    for fate, group in groupby(album.pairs, key=lambda each: each.fate):
        cards = [card(each, album) for each in group]
        parts.append(element("h4", text_of(f"{fate.value} ({len(cards)})")))
        parts.append(element("div", *cards, class_="cards"))
    if album.pairs_left_out:
        more = f"{count_of(album.pairs_left_out)} more pairs are not shown: flocc evaluate RUN --pictures N shows more."
        parts.append(element("p", text_of(more), class_="note"))
    return "".join(parts) + sheets(album)


def card(each: ShownPair, album: Album) -> str:
    """A small picture of a pair that opens its sheet."""
    caption = element("span", text_of(f"{each.pair.query} – {each.pair.match}"))
    return element(
        "a", pair_drawing(each, album.pictures, None, tall=False), caption, href=f"#{each.name}", class_="card"
    )


def sheets(album: Album) -> str:
    """All sheets, each with the way to the one before and after."""
    names = [each.name for each in album.pairs]
    return "".join(sheet(each, album, names[k - 1], names[(k + 1) % len(names)]) for k, each in enumerate(album.pairs))


def sheet(each: ShownPair, album: Album, before: str, after: str) -> str:
    """One pair, large: both pictures with the matches, and what is known of it."""
    found = album.matches.get(each.name)
    ways = (("‹ previous", before, None), ("close", "closed", "close"), ("next ›", after, None))
    links = element("nav", *(element("a", text, href=f"#{to}", class_=kind) for text, to, kind in ways))
    inside = element(
        "div",
        links,
        element("h3", text_of(f"{each.pair.query} – {each.pair.match}")),
        element("p", text_of(said_of(each, found))),
        pair_drawing(each, album.pictures, found, tall=False),
        pair_drawing(each, album.pictures, found, tall=True),
    )
    shade = element("a", "", href="#closed", class_="shade", aria_label="close")
    return element("section", shade, inside, id=each.name, class_="sheet", aria_label=f"pair {each.name}")


def said_of(each: ShownPair, found: Drawn | None) -> str:
    """What is known of a pair, in one sentence."""
    pair = each.pair
    words = {
        Fate.WRONG: "Accepted, although ground truth says otherwise",
        Fate.UNUSED: "Accepted, and left out by the solver",
        Fate.REFUSED: f"Rejected: {pair.reason}",
        Fate.ACCEPTED: "Accepted",
    }
    parts = [words[each.fate]]
    if each.fate is Fate.WRONG:
        parts.append("the solver left it out" if pair.used is False else "the solver used it")
    if each.right:
        parts.append("right by ground truth")
    parts += [f"match ratio {number(pair.ratio)}"] if pair.ratio is not None else []
    parts += [f"probability {number(pair.probability)}"] if pair.probability is not None else []
    parts += [f"similarity {number(pair.similarity)}"] if pair.similarity is not None else []
    if found is not None:
        parts.append(f"{found.agree_count} of {found.count} matches agree with one pose")
    return "; ".join(parts) + "."


def pair_drawing(each: ShownPair, pictures: Mapping[KeyframeId, Picture], found: Drawn | None, tall: bool) -> str:
    """Both pictures beside each other, or one above the other, and lines between what was matched."""
    query, match = pictures[each.pair.query], pictures[each.pair.match]
    shift = (0, query.height_px + GAP_PX) if tall else (query.width_px + GAP_PX, 0)
    width = max(query.width_px, match.width_px) if tall else query.width_px + GAP_PX + match.width_px
    height = query.height_px + GAP_PX + match.height_px if tall else max(query.height_px, match.height_px)
    ends = (each.pair.query, (0, 0)), (each.pair.match, shift)
    parts = [element("use", href=f"#seen-{anchor(keyframe)}", x=x, y=y) for keyframe, (x, y) in ends]
    if found is not None:
        scales = (query.width_px, query.height_px, match.width_px, match.height_px)
        parts.append(element("g", *match_lines(found.others.tolist(), scales, shift), class_="others"))
        parts.append(element("g", *match_lines(found.agree.tolist(), scales, shift), class_="agree"))
    return element(
        "svg", *parts, viewBox=f"0 0 {width} {height}", role="img", class_="tall" if tall else "flat",
        aria_label=f"pictures of {each.pair.query} and {each.pair.match}",
    )  # fmt: skip


def match_lines(lines: Sequence[Sequence[float]], scales: Sequence[int], shift: tuple[int, int]) -> list[str]:
    """Lines from the query's picture to the match's."""
    made = []
    for line in lines:
        x1, y1, x2, y2 = (float(value * scale) for value, scale in zip(line, scales, strict=True))
        made.append(f'<path d="M{x1:.0f} {y1:.0f}L{x2 + shift[0]:.0f} {y2 + shift[1]:.0f}"/>')
    return made
