"""The page in a map's folder that shows it: from above, in figures, and as far as there are pictures in pictures."""

import base64
from collections.abc import Sequence
from importlib.resources import files

import numpy as np

from flocc_agent.runtime.map_folder import MapManifest
from flocc_launch.maps.map_info import manifest_lines
from flocc_launch.maps.solving import SolvedMap
from flocc_launch.maps.thumbnails import Thumbnail
from flocc_launch.report.figure_map import (
    WIDTH_PX,
    MapScene,
    MapView,
    colour,
    compass,
    line_of,
    scale_bar,
    starts_of,
    view_of,
)
from flocc_launch.report.svg import element, svg, text_of
from flocc_protocol.ids import LogId

CLOSURES_DRAWN_MAX = 500


def map_page(manifest: MapManifest, solved: SolvedMap, pictures: Sequence[Thumbnail]) -> str:
    """The whole page."""
    rows = [
        element("tr", element("th", text_of(name)), element("td", text_of(value)))
        for name, value in manifest_lines(manifest)
    ]
    shown = [_figure(picture) for picture in pictures]
    body = element(
        "main",
        element("p", "flocc map", class_="kicker"),
        element("h1", text_of(f"{manifest.name}, edition {manifest.edition}: {manifest.frame}")),
        element("figure", _drawing(solved), element("figcaption", "From above, at camera poses; grey: closures used.")),
        element("table", *rows, class_="narrow"),
        *([element("h2", "Places"), element("div", *shown, class_="tiles")] if shown else []),
    )
    head = element("meta", charset="utf-8").removesuffix("</meta>")
    head += element("title", text_of(f"flocc map: {manifest.name}"))
    head += element("style", files("flocc_launch.report").joinpath("page.css").read_text(encoding="utf-8"))
    return "<!doctype html>\n" + element("html", element("head", head), element("body", body), lang="en") + "\n"


def _figure(picture: Thumbnail) -> str:
    data = base64.b64encode(picture.jpeg).decode()
    image = element("img", src=f"data:image/jpeg;base64,{data}", alt=str(picture.keyframe)).removesuffix("</img>")
    return element("figure", image, element("figcaption", text_of(picture.keyframe)))


def _drawing(solved: SolvedMap) -> str:
    """All logs and closures, in the plane of the greatest extent."""
    saved = solved.saved
    names = [str(log) for log in saved.logs]
    lines_m = {str(log): saved.T_map_camera[log][:, :3, 3] for log in saved.logs}
    scene = MapScene("map", "", lines_m, {}, False)
    view = view_of([scene])
    layers = [element("rect", x=0.5, y=0.5, width=WIDTH_PX - 1, height=view.height_px - 1, rx=8, class_="frame")]
    layers += _closures(solved, view)
    for name, points in lines_m.items():
        layers.append(element("g", line_of(points, view, "track"), class_=colour(names, name)))
    layers += starts_of(scene, view, names)
    return svg(WIDTH_PX, view.height_px, *layers, scale_bar(view), compass(view), label=f"map of {', '.join(names)}")


def _closures(solved: SolvedMap, view: MapView) -> list[str]:
    saved = solved.saved

    def at(log: LogId, index: int) -> tuple[float, float]:
        return view(np.asarray(saved.T_map_camera[log][index, :3, 3]))

    ends = [(at(q.log, q.index), at(m.log, m.index)) for q, m in list(saved.closures)[:CLOSURES_DRAWN_MAX]]
    return [element("g", element("line", x1=x1, y1=y1, x2=x2, y2=y2), class_="closure") for (x1, y1), (x2, y2) in ends]
