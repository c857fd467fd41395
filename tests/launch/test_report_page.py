"""report.html: what it says, that it needs nothing else, and that it is well formed."""

import re
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic
from tests.launch.test_dashboard import browse

from flocc_launch.report import RunReport, finish
from flocc_launch.report.figure_map import MapScene, map_figure, view_of
from flocc_launch.report.figure_time import room_for
from flocc_launch.report.html import page
from flocc_launch.report.svg import Axis, thinned
from flocc_launch.report.verdict import verdict
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.plain_numbers import number, seconds, size_of

VOID = {"meta", "input"}


class Balance(HTMLParser):
    """Fails on an end tag that closes something else."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def html_of(path: Path, options: Synthetic | None = None) -> tuple[str, RunReport]:
    folder = synthetic_run.write(path / "run", options)
    report = finish(folder)
    return (folder.path / "report.html").read_text(), report


@pytest.mark.parametrize(
    "options",
    [Synthetic(), Synthetic(died=("r1", 50.0)), Synthetic(merged_s=None), Synthetic(with_truth=False)],
    ids=["merged", "died", "apart", "no truth"],
)
def test_the_page_is_well_formed_and_needs_nothing_else(tmp_path: Path, options: Synthetic) -> None:
    html, _ = html_of(tmp_path, options)
    parser = Balance()
    parser.feed(html)
    assert parser.open == []
    assert not re.search(r"https?://|<script|<link|@import|url\(|src=", html)
    drawings = re.findall(r"<svg.*?</svg>", html, re.DOTALL)
    assert len(drawings) > 8
    for drawing in drawings:
        assert "nan" not in re.sub(r">[^<]*<", "><", drawing).lower()
        ElementTree.fromstring(drawing)


def test_the_page_shows_every_part(tmp_path: Path) -> None:
    html, report = html_of(tmp_path)
    for heading in ("Where the robots went", "What happened when", "Loop closures", "What travelled", "Settings"):
        assert f"<h2>{heading}</h2>" in html
    for text in ("63 accepted", "31 rejected", "few correspondences", "latents", "map/r1", "one map after 41.3 s"):
        assert text in html
    assert html.count('class="closure"') == report.closures.accepted + 1
    assert ">seed</td><td><code>7</code>" in html


def test_without_ground_truth_no_tile_is_empty(tmp_path: Path) -> None:
    tiles = {known: html_of(tmp_path / str(known), Synthetic(with_truth=known))[0] for known in (True, False)}
    assert [html.count('class="tile"') for html in tiles.values()] == [7, 5]
    assert "<b>–</b>" not in tiles[False]


def test_errors_during_the_run_are_left_out_where_no_round_had_one_map(tmp_path: Path) -> None:
    html, report = html_of(tmp_path / "apart", Synthetic(merged_s=None))
    assert report.iate_m is None
    assert not re.search("during the run|During the run|0 rounds", html)
    assert f"<b>{number(report.if1)}</b><span>F1 of closures</span>" in html
    html, _ = html_of(tmp_path / "merged")
    assert ">during the run<" in html


def test_names_that_begin_in_one_place_stand_below_each_other(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    finish(folder)
    loaded = load(folder)
    line = loaded.tracks["r1"].T_world_body[:, :3, 3]
    scene = MapScene("After", "", dict.fromkeys(("anna", "ben", "carl"), line), {}, False)
    names = re.findall(r'<text x="([\d.]+)" y="([\d.]+)" class="name"', map_figure(scene, view_of([scene]), loaded))
    assert len({x for x, _ in names}) == 1
    heights = [float(y) for _, y in names]
    assert [lower - upper for upper, lower in pairwise(heights)] == pytest.approx([14.0, 14.0], abs=0.2)


def test_long_names_of_robots_have_room_beside_the_bars() -> None:
    assert room_for(["r1", "r1 ↔ r2"]) == room_for([]) < 120
    assert 170 < room_for(["r1", "carl_iphone ↔ ben_pixel"]) < room_for(["r" * 99]) < 400


def test_the_page_says_why_maps_have_not_merged(tmp_path: Path) -> None:
    assert "Why the maps have not merged" in html_of(tmp_path / "apart", Synthetic(merged_s=None))[0]
    assert "Why the maps have not merged" not in html_of(tmp_path / "merged")[0]


def test_names_from_outside_are_escaped(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    run = folder.run().model_copy(update={"scenario": "<b onload='x'>&", "settings": {"<i>": "</code>"}})
    folder.write_run(run)
    report = finish(folder)
    html = page(report, load(folder))
    assert "<b onload" not in html
    assert "<i>" not in html
    assert "&lt;b onload=" in html


def test_the_verdict_says_what_became_of_the_maps(tmp_path: Path) -> None:
    said = {
        "merged": Synthetic(),
        "died": Synthetic(died=("r1", 50.0)),
        "apart": Synthetic(merged_s=None),
        "no truth": Synthetic(with_truth=False),
    }
    verdicts = {name: verdict(html_of(tmp_path / name, options)[1]) for name, options in said.items()}
    assert verdicts == {
        "merged": "All three robots found one common map after 41.3 s. "
        "The joint error fell from 1.64 m (odometry alone) to 0.134 m.",
        "died": "r1 died; the other two robots found one common map after 41.3 s. "
        "The joint error of the survivors fell from 1.97 m (odometry alone) to 0.106 m.",
        "apart": "The robots did not merge: three separate maps at the end.",
        "no truth": "All three robots found one common map after 41.3 s. "
        "There is no ground truth, so the error is not known.",
    }


def test_the_verdict_does_not_hide_a_correction_that_did_not_help(tmp_path: Path) -> None:
    report = html_of(tmp_path)[1].model_copy(update={"ate_joint_m": 2.0})
    assert verdict(report).endswith(
        "The joint error is 2.00 m: not less than odometry put at the true starts (1.64 m), which no robot knows."
    )
    between = {"ate_joint_m": 1.0, "ate_joint_odometry_aligned_m": 0.9}
    assert verdict(report.model_copy(update=between)).endswith(
        "The joint error is 1.00 m: less than odometry from its true starts (1.64 m), "
        "but not less than that odometry aligned as the map is (0.900 m)."
    )


def test_the_verdict_claims_nothing_for_a_single_robot(tmp_path: Path) -> None:
    whole = html_of(tmp_path)[1]
    lone = {"robots": ["r1"], "robot_details": whole.robot_details[:1]}
    assert verdict(whole.model_copy(update=lone)).startswith("One robot ran, alone, and closed ")
    none = whole.closures.model_copy(update={"accepted": 0})
    report = whole.model_copy(update={**lone, "closures": none})
    assert (
        verdict(report) == "One robot ran, alone: nothing corrects its odometry. Its error is 0.134 m after alignment."
    )
    unknown = report.model_copy(update={"ate_joint_m": None})
    assert verdict(unknown) == "One robot ran, alone: nothing corrects its odometry."


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (number(0.13353), "0.134"),
        (number(1.6371, "m"), "1.64 m"),
        (number(0), "0"),
        (number(None), "–"),
        (number(12345.6), "12 346"),
        (seconds(61), "61.0 s"),
        (seconds(125), "2 min 5 s"),
        (seconds(7300), "2 h 1 min"),
        (size_of(12_263_100), "12.3 MB"),
        (size_of(640), "640 B"),
    ],
)
def test_numbers_are_written_for_people(text: str, expected: str) -> None:
    assert text == expected


def test_ticks_are_round_and_within_the_axis() -> None:
    assert Axis(0.0, 101.7, 0, 1).ticks(5) == [0, 50, 100]
    assert Axis(-0.35, 0.35, 0, 1).ticks(3) == pytest.approx([0.0], abs=1e-12)
    assert Axis(3.0, 3.0, 0, 1).ticks() == [3.0]


def test_a_long_line_keeps_its_end() -> None:
    points = [(float(k), 0.0) for k in range(10_007)]
    kept = thinned(points)
    assert len(kept) <= 1501
    assert (kept[0], kept[-1]) == (points[0], points[-1])


@pytest.mark.slow
def test_the_page_is_as_wide_as_a_phone(tmp_path: Path) -> None:
    """In headless Chromium, whose window is no narrower than 500 px: so in a frame of 390."""
    folder = synthetic_run.write(tmp_path / "run", Synthetic(died=("r1", 50.0)))
    finish(folder)
    script = "let page = this.contentDocument.documentElement; document.title = page.scrollWidth - page.clientWidth"
    frame = f'<iframe src="run/report.html" style="width:390px;height:900px;border:0" onload="{script}"></iframe>'
    (tmp_path / "phone.html").write_text(
        f"<!doctype html><html><head><title>-</title></head><body>{frame}</body></html>"
    )
    seen = browse((tmp_path / "phone.html").as_uri(), tmp_path / "profile", "--allow-file-access-from-files")
    assert re.findall(r"<title>(.*?)</title>", seen) == ["0"]
