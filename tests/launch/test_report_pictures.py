"""Pictures in report.html: which pairs are shown, that they are the right pictures, and that every link opens one."""

import json
import re
import shutil
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.doc_props import HEIGHT, WIDTH, write_own_data
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic
from tests.launch.test_dashboard import browse
from tests.launch.test_report_page import Balance

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.registration import Registration
from flocc_agent.geometry import pose_from_tq, so3_exp, tq_from_pose
from flocc_agent.perception.backends import build_perception
from flocc_agent.runtime.recording import Frame, Recording
from flocc_launch.report.album import EMPTY, PAIR_SIDE_PX, Album, album_of
from flocc_launch.report.evaluate import evaluate
from flocc_launch.report.finish import finish
from flocc_launch.report.paper_figures import PlotError, write_plots
from flocc_launch.report.shown_pairs import Fate, evenly, shares, shown_pairs
from flocc_launch.runs.loaded_run import LoadedRun, load
from flocc_launch.runs.run_folder import RunFolder, write_json
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.shipped import read_scenario
from flocc_launch.simulation.simulate import simulate


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunFolder]:
    """A simulated run of two robots with real pictures."""
    place = tmp_path_factory.mktemp("pictures")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLOCC_CACHE", str(place / "cache"))
        scenario = read_scenario(str(write_own_data(place / "my_data")), {"seed": 1}, agents=2)
        simulate(scenario, place / "run", recordings=recordings(scenario))
        yield RunFolder.open(place / "run")


@pytest.fixture(scope="module")
def loaded(seen: RunFolder) -> LoadedRun:
    return load(seen)


@pytest.fixture(scope="module")
def album(seen: RunFolder, loaded: LoadedRun) -> Album:
    return album_of(seen, loaded)


def test_every_link_leads_to_something_on_the_page(seen: RunFolder) -> None:
    html = (seen.path / "report.html").read_text()
    parser = Balance()
    parser.feed(html)
    assert parser.open == []
    names = set(re.findall(r' id="([^"]*)"', html))
    links = set(re.findall(r'href="#([^"]*)"', html))
    assert links - names == {"closed"}
    assert not re.search(r"https?://|<script|<link|@import|url\(|src=", re.sub(r"base64,[^\"]*", "", html))


def test_a_closure_on_the_map_opens_its_two_keyframes(seen: RunFolder, album: Album) -> None:
    html = (seen.path / "report.html").read_text()
    assert album.pairs
    for each in album.pairs:
        sheet = re.search(rf'<section id="{re.escape(each.name)}".*?</section>', html, re.S)
        assert sheet is not None
        for keyframe in (each.pair.query, each.pair.match):
            assert f'<use href="#seen-{str(keyframe).replace("/", ".")}"' in sheet[0]
        assert re.search(rf'<a href="#{re.escape(each.name)}"><(g|path)', html), "not on the map"
        assert re.search(rf'<a href="#{re.escape(each.name)}" class="card"', html), "not in the gallery"


def difference(frame: Frame, shown: NDArray[Any]) -> float:
    whole = cv2.imread(str(frame.image_path))
    assert whole is not None
    return float(np.abs(shown.astype(float) - whole).mean())


def test_a_keyframe_shows_the_picture_of_its_stamp(seen: RunFolder, loaded: LoadedRun, album: Album) -> None:
    for keyframe, picture in list(album.pictures.items())[:4]:
        path = seen.recording(keyframe.log.robot)
        assert path is not None
        stamp_s = loaded.tracks[keyframe.log.robot].stamps_s[keyframe.index]
        shown = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        assert shown.shape[:2] == (picture.height_px, picture.width_px) == (HEIGHT, WIDTH)
        assert max(shown.shape) <= PAIR_SIDE_PX
        nearest = min(Recording.open(path).frames, key=lambda frame: difference(frame, shown))
        assert nearest.stamp_s == pytest.approx(stamp_s, abs=1e-6)
    html = (seen.path / "report.html").read_text()
    held = re.findall(r'<image id="seen-[^"]*"[^>]*base64,([^"]*)"', html)
    assert sorted(map(b64decode, held)) == sorted(picture.jpeg for picture in album.pictures.values())


def test_the_lines_are_what_the_front_end_verifies(seen: RunFolder, loaded: LoadedRun, album: Album) -> None:
    each = next(each for each in album.pairs if each.fate is Fate.ACCEPTED)
    perception, ends = build_perception(PerceptionConfig()), []
    for keyframe in (each.pair.query, each.pair.match):
        recording = Recording.open(Path(loaded.run.recordings[keyframe.log.robot]))
        stamp_s = loaded.tracks[keyframe.log.robot].stamps_s[keyframe.index]
        frame = min(recording.frames, key=lambda f: abs(f.stamp_s - stamp_s))
        ends.append(perception.encode(recording.load_image(frame)))
    result = perception.register(ends[0], ends[1], None)
    found = album.matches[each.name]
    assert isinstance(result, Registration)
    assert (found.agree_count, found.count > found.agree_count) == (result.correspondences, True)
    assert np.all((found.agree > -0.01) & (found.agree < 1.01))
    assert f"{found.agree_count} of {found.count} matches agree" in (seen.path / "report.html").read_text()


def test_what_is_not_there_is_not_shown(seen: RunFolder, tmp_path: Path) -> None:
    folder = RunFolder.open(Path(shutil.copytree(seen.path, tmp_path / "run")))
    unknown = folder.run().model_copy(update={"perception": {}})
    folder.write_run(unknown)
    without_matches = album_of(folder, load(folder))
    assert without_matches.pairs
    assert without_matches.matches == {}
    folder.write_run(unknown.model_copy(update={"recordings": {"r1": "gone", "r2": "gone"}}))
    finish(folder)
    assert album_of(folder, load(folder)) == EMPTY
    html = (folder.path / "report.html").read_text()
    assert ("<image" in html, 'class="sheet"' in html, "What they saw" in html) == (False, False, False)


def test_codes_of_synthetic_perception_are_not_shown_as_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    changes = {"duration_s": 6.0, "simulation.optimiser": "quick", "settle_s": 0.5}
    scenario = read_scenario("meeting", changes)
    simulate(scenario, tmp_path / "run", recordings=recordings(scenario))
    folder = RunFolder.open(tmp_path / "run")
    assert any(len(track) for track in load(folder).tracks.values())
    assert album_of(folder, load(folder)) == EMPTY


def test_fewer_or_no_pictures_are_shown_on_demand(seen: RunFolder, tmp_path: Path) -> None:
    run = Path(shutil.copytree(seen.path, tmp_path / "run"))
    told: list[tuple[int, int]] = []
    evaluate(run, pairs_max=2, progress=lambda done, total: told.append((done, total)))
    html = (run / "report.html").read_text()
    assert html.count('class="sheet"') == 2
    assert "more pairs are not shown" in html
    assert told[-1][0] < told[-1][1] <= 6
    evaluate(run, pairs_max=0)
    assert "<image" not in (run / "report.html").read_text()


def run_with_a_wrong_closure(path: Path) -> LoadedRun:
    folder = synthetic_run.write(path, Synthetic())
    for robot in ("r1", "r2", "r3"):
        place = folder.path / "robots" / robot / "result.json"
        fields = json.loads(place.read_text())
        T = pose_from_tq(np.array(fields["closures"][5]["T_query_match_unscaled"]))
        T[:3, :3] = T[:3, :3] @ so3_exp(np.array([0.0, 0.0, 0.5]))
        fields["closures"][5]["T_query_match_unscaled"] = [float(v) for v in tq_from_pose(T)]
        write_json(place, fields)
    return load(folder)


def test_wrong_closures_come_first_and_every_fate_has_its_share(tmp_path: Path) -> None:
    loaded = run_with_a_wrong_closure(tmp_path / "run")
    shown = shown_pairs(loaded, 9)
    assert [each.fate for each in shown] == [Fate.WRONG] + 4 * [Fate.REFUSED] + 4 * [Fate.ACCEPTED]
    closure = loaded.results["r1"].closures[5]
    assert {str(shown[0].pair.query), str(shown[0].pair.match)} == {closure.query, closure.match}
    assert [each.right for each in shown] == [False, None, None, None, None, True, True, True, True]
    refused, accepted = ([each.pair.ratio for each in shown if each.fate is fate] for fate in list(Fate)[2:])
    assert refused == sorted((pair.ratio for pair in loaded.pairs if pair.rejected and pair.ratio), reverse=True)[:4]
    assert (
        accepted == sorted(each.pair.ratio or 0 for each in shown_pairs(loaded, 999) if each.fate is Fate.ACCEPTED)[:4]
    )


def test_shares_are_even_and_leave_nothing_over() -> None:
    assert shares([0, 3, 100, 100], 24) == [0, 3, 11, 10]
    assert shares([1, 1, 0, 0], 24) == [1, 1, 0, 0]
    assert shares([5, 5, 5, 5], 0) == [0, 0, 0, 0]


def test_views_are_even_along_the_way_and_not_in_time() -> None:
    waits = np.zeros((30, 3))
    walks = np.column_stack([np.arange(1.0, 11.0), np.zeros(10), np.zeros(10)])
    assert evenly(np.vstack([waits, walks]), 5) == [0, 31, 33, 35, 37]
    assert evenly(np.zeros((4, 3)), 5) == [0]


def test_figures_are_written_as_png_and_svg(seen: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run = Path(shutil.copytree(seen.path, tmp_path / "run"))
    said = evaluate(run, plot=True, pairs_max=0)
    names = [f"{name}.{kind}" for name in ("trajectories", "errors") for kind in ("png", "svg")]
    assert [line for line in said.splitlines() if line.startswith("figure: ")] == [
        f"figure: {(run / name).resolve()}" for name in names
    ]
    for name in ("trajectories.png", "errors.png"):
        drawn = cv2.imread(str(run / name))
        assert drawn is not None
        assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 50
    before = [(run / name).read_bytes() for name in names]
    evaluate(run, plot=True, pairs_max=0)
    assert [(run / name).read_bytes() for name in names] == before, "not the same figures"


def test_a_run_without_anything_to_draw_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    folder = synthetic_run.write(tmp_path / "run", Synthetic(with_truth=False))
    for robot in ("r1", "r2", "r3"):
        (folder.path / "robots" / robot / "result.json").unlink()
    with pytest.raises(PlotError, match="no robot has a corrected trajectory or ground truth to draw"):
        write_plots(load(folder), folder.path)


@pytest.mark.slow
def test_a_sheet_fits_a_phone(seen: RunFolder, album: Album, tmp_path: Path) -> None:
    """In headless Chromium, whose window is no narrower than 500 px: so in a frame of 390."""
    shutil.copy(seen.path / "report.html", tmp_path)
    name = album.pairs[0].name
    script = (
        "let page = this.contentDocument, root = page.documentElement, sheet = page.querySelector('.sheet:target'),"
        "tall = sheet.querySelector('svg.tall').getBoundingClientRect(), flat = sheet.querySelector('svg.flat');"
        "document.title = [root.scrollWidth - root.clientWidth, getComputedStyle(flat).display,"
        "tall.width > 250, tall.height > tall.width].join()"
    )
    frame = f'<iframe src="report.html#{name}" style="width:390px;height:900px;border:0" onload="{script}"></iframe>'
    (tmp_path / "phone.html").write_text(
        f"<!doctype html><html><head><title>-</title></head><body>{frame}</body></html>"
    )
    shown = browse((tmp_path / "phone.html").as_uri(), tmp_path / "profile", "--allow-file-access-from-files")
    assert re.findall(r"<title>(.*?)</title>", shown) == ["0,none,true,true"]
