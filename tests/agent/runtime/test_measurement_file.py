"""Claims on `measurements.jsonl`: what was seen belongs to its frame, positions are interpolated, damage is named."""

from pathlib import Path

import numpy as np
import pytest

from flocc_agent.core.measurements import Fix, GeodeticFix, MetricClosure, TagSighting
from flocc_agent.runtime.measurement_file import NOTHING, read_measurements
from flocc_agent.runtime.text_tables import RecordingError
from flocc_protocol.ids import KeyframeId, LogId

FRAMES_S = [0.0, 1.0, 2.0, 3.0, 10.0]
SIXES = "[1, 1, 1, 1, 1, 1]"
TAG = f'{{"stamp_s": 2.01, "kind": "tag", "tag": "7", "T_body_tag": [1, 0, 0, 1, 0, 0, 0], "covariance": {SIXES}}}'


def fix(stamp_s: float, x_m: float) -> str:
    return f'{{"stamp_s": {stamp_s}, "kind": "fix", "position_m": [{x_m}, 0, 0], "covariance_m2": [1, 1, 1]}}'


def written(folder: Path, *lines: str) -> Path:
    path = folder / "measurements.jsonl"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_no_file_is_no_measurements(tmp_path: Path) -> None:
    assert read_measurements(tmp_path / "measurements.jsonl", FRAMES_S) is NOTHING


def test_what_was_seen_belongs_to_the_nearest_frame_which_is_kept(tmp_path: Path) -> None:
    found = read_measurements(written(tmp_path, TAG, ""), FRAMES_S)
    assert [stamp_s for stamp_s in FRAMES_S if found.keeps(stamp_s)] == [2.0]
    (stamped,) = found.at(2.0)
    assert isinstance(stamped.measurement, TagSighting)
    assert found.at(1.0) == ()


def test_positions_are_interpolated_to_a_keyframe_and_keep_none(tmp_path: Path) -> None:
    found = read_measurements(written(tmp_path, fix(1.5, 5.0), fix(0.5, 3.0), fix(9.0, 9.0)), FRAMES_S)
    assert not any(found.keeps(stamp_s) for stamp_s in FRAMES_S)
    (stamped,) = found.at(1.0)
    assert isinstance(stamped.measurement, Fix)
    np.testing.assert_allclose(stamped.measurement.position_m, [4.0, 0.0, 0.0])
    assert [len(found.at(stamp_s)) for stamp_s in FRAMES_S] == [0, 1, 0, 0, 0], "not over gaps, not beyond the ends"


def test_gnss_is_interpolated_over_the_date_line(tmp_path: Path) -> None:
    rows = [
        f'{{"stamp_s": {t}, "kind": "gnss", "latitude_deg": 10.0, "longitude_deg": {east}, "altitude_m": {t}, '
        '"covariance_m2": [1, 1, 4]}'
        for t, east in ((0.5, 179.9), (1.5, -179.9))
    ]
    (stamped,) = read_measurements(written(tmp_path, *rows), FRAMES_S).at(1.0)
    assert isinstance(stamped.measurement, GeodeticFix)
    assert abs(stamped.measurement.longitude_deg) == pytest.approx(180.0)
    assert stamped.measurement.altitude_m == pytest.approx(1.0)


def test_a_closure_with_an_earlier_frame_keeps_both_and_finds_its_keyframe(tmp_path: Path) -> None:
    row = (
        '{"stamp_s": 3.0, "kind": "closure", "match_stamp_s": 1.0, "T_query_match": [1, 0, 0, 1, 0, 0, 0], '
        '"covariance": [1, 1, 1, 1, 1, 1]}'
    )
    found = read_measurements(written(tmp_path, row), FRAMES_S)
    assert [stamp_s for stamp_s in FRAMES_S if found.keeps(stamp_s)] == [1.0, 3.0]
    made = found.at(3.0)[0].made(lambda stamp_s: KeyframeId(LogId("r1"), round(stamp_s)))
    assert isinstance(made, MetricClosure)
    assert made.match == KeyframeId(LogId("r1"), 1)


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ('{"stamp_s": 1.0, "kind": "tag", "tag"', "is cut off or not JSON"),
        ("[1, 2]", "must be an object"),
        ('{"kind": "tag"}', "stamp_s must be a number of seconds, not None"),
        ('{"stamp_s": true, "kind": "tag"}', "stamp_s must be a number"),
        ('{"stamp_s": NaN, "kind": "tag"}', "stamp_s must be a number"),
        ('{"stamp_s": 1.0}', "kind must be the name of a kind"),
        ('{"stamp_s": 1.0, "kind": "smell"}', "'smell' is no kind of measurement"),
        ('{"stamp_s": 1.0, "kind": "start", "T_world_body": [0, 0, 0, 1, 0, 0, 0]}', "covariance is missing"),
        (TAG.replace("2.01", "5.0"), "no frame lies within 0.05 s of 5.0 s"),
        (TAG.replace("[1, 1, 1, 1, 1, 1]", "[1, 1, 1, 1, 1, -1]"), "not positive definite"),
        (TAG.replace('"tag": "7"', '"tag": "7", "match_stamp_s": 1.0'), "tag has no match_stamp_s"),
    ],
)
def test_a_damaged_line_is_named(tmp_path: Path, line: str, complaint: str) -> None:
    path = written(tmp_path, TAG, line)
    with pytest.raises(RecordingError) as caught:
        read_measurements(path, FRAMES_S)
    assert str(caught.value).startswith(f"{path}:2: ")
    assert complaint in str(caught.value)


def test_a_file_that_is_no_text_is_named(tmp_path: Path) -> None:
    path = tmp_path / "measurements.jsonl"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match=r"measurements\.jsonl: cannot be read"):
        read_measurements(path, FRAMES_S)


def test_gnss_is_interpolated_over_a_pole(tmp_path: Path) -> None:
    rows = [
        f'{{"stamp_s": {t}, "kind": "gnss", "latitude_deg": 89.9999, "longitude_deg": {east}, "altitude_m": 0.0, '
        '"covariance_m2": [1, 1, 4]}'
        for t, east in ((0.5, 0.0), (1.5, 180.0))
    ]
    (stamped,) = read_measurements(written(tmp_path, *rows), FRAMES_S).at(1.0)
    assert isinstance(stamped.measurement, GeodeticFix)
    assert stamped.measurement.latitude_deg == pytest.approx(90.0, abs=1e-9)


WHOLE = f'"T_query_match": [0, 0, 0, 1, 0, 0, 0], "covariance": {SIXES}'
BAD_TAG = '{"stamp_s": 1, "kind": "tag", "tag": %s, "T_body_tag": [1, 0, 0, 1, 0, 0, 0], "covariance": ' + SIXES + "}"
GNSS = (
    '{"stamp_s": 1, "kind": "gnss", "latitude_deg": %s, "longitude_deg": 1, "altitude_m": 0, '
    '"covariance_m2": [1, 1, 1]}'
)


@pytest.mark.parametrize(
    "line",
    [
        f'{{"stamp_s": {"9" * 400}, "kind": "fix"}}',
        "[" * 100_000,
        f'{{"stamp_s": 1, "kind": "odometry", "covariance": [{"9" * 400}]}}',
        f'{{"stamp_s": 1, "kind": "closure", "match": 5, {WHOLE}}}',
        f'{{"stamp_s": 1, "kind": "closure", "match": null, {WHOLE}}}',
        f'{{"stamp_s": 2, "kind": "closure", "match": "r2/3", "match_stamp_s": 1, {WHOLE}}}',
        f'{{"stamp_s": 2, "kind": "closure", "match_stamp_s": {"9" * 400}, {WHOLE}}}',
        *(BAD_TAG % tag for tag in ("null", "[1]", '{"a": 1}', "true", '"\\ud800"', '"a\\nb"')),
        *(GNSS % value for value in ("[1]", "true", '"1"', "null")),
        f'{{"stamp_s": 2, "kind": "start", "T_world_body": [0, 0, 0, 1, 0, 0, 0], "covariance": {SIXES}}}',
    ],
)
def test_a_value_of_a_kind_that_nobody_expects_is_named(tmp_path: Path, line: str) -> None:
    path = written(tmp_path, TAG, line)
    with pytest.raises(RecordingError, match=rf"{path}:2: "):
        read_measurements(path, FRAMES_S)
