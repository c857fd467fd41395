"""The file without a name gives back what was put, and a full disk or a short one is no crash without a word."""

import os
from pathlib import Path

import pytest

from flocc_agent.runtime.database import StoreError
from flocc_agent.runtime.page_file import PageFile


def test_pieces_come_back_and_leave_no_file(tmp_path: Path) -> None:
    pages = PageFile(tmp_path)
    assert list(tmp_path.iterdir()) == []
    places = [pages.put(bytes([k]) * (k + 1)) for k in range(5)]
    for k, place in enumerate(places):
        assert place is not None
        assert pages.get(place, k + 1) == bytes([k]) * (k + 1)
    assert list(tmp_path.iterdir()) == []
    pages.close()


def test_a_full_disk_takes_nothing_until_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages = PageFile(tmp_path)
    first = pages.put(b"first")

    def full(_file: int, _data: bytes, _place: int) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        assert pages.put(b"second") is None
    third = pages.put(b"third")
    assert first is not None
    assert third is not None
    assert (pages.get(first, 5), pages.get(third, 5)) == (b"first", b"third")
    assert PageFile(tmp_path / "no folder").put(b"piece") is None


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    pages = PageFile(tmp_path)
    with pytest.raises(StoreError, match="ends early"):
        pages.get(0, 5)
    pages.put(b"12345")
    with pytest.raises(StoreError, match="ends early"):
        pages.get(3, 5)


def test_no_more_of_the_disk_is_used_than_may_be(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pages = PageFile(tmp_path, bytes_max=10)
    first, second = pages.put(b"12345"), pages.put(b"67890")
    assert first is not None
    assert second is not None
    assert pages.put(b"x") is None
    assert pages.put(b"y") is None
    assert [record.getMessage() for record in caplog.records] == [
        f"old records stay in memory: they fill 10 bytes of {tmp_path}"
    ]
    pages.free(first, 5)
    assert pages.put(b"abcde") == first
    assert (pages.get(first, 5), pages.get(second, 5)) == (b"abcde", b"67890")
    pages.close()
