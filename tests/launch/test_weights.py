"""`flocc weights`: status, check, synthesize, and downloads that resume and are verified, from a local server."""

import hashlib
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from flocc_agent.config import Mast3rConfig
from flocc_launch.setup.weight_files import NEEDED, WeightsError, check, fetch, status, synthesize

CONTENT = bytes(range(256)) * 4000


class Server(ThreadingHTTPServer):
    """Serves one file with ranges, and can cut connections."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.content = CONTENT
        self.tag = '"1"'
        self.cuts = 0
        self.ranges: list[str | None] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/weights.pth"


class Handler(BaseHTTPRequestHandler):
    """Answers GET with or without a range."""

    server: Server

    def do_GET(self) -> None:
        if self.path != "/weights.pth":
            self.send_error(404)
            return
        wanted = self.headers.get("Range")
        self.server.ranges.append(wanted)
        content, start = self.server.content, 0
        if wanted and self.headers.get("If-Range") == self.server.tag:
            start = int(wanted.removeprefix("bytes=").rstrip("-"))
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(content) - start))
        self.send_header("ETag", self.server.tag)
        self.end_headers()
        body = content[start:]
        if self.server.cuts > 0:
            self.server.cuts -= 1
            body = body[: len(body) // 2]
        self.wfile.write(body)

    def log_message(self, *arguments: object) -> None:
        """Keep the tests' output clean."""


@pytest.fixture
def server() -> Iterator[Server]:
    running = Server()
    thread = threading.Thread(target=running.serve_forever, daemon=True)
    thread.start()
    yield running
    running.shutdown()
    running.server_close()


def test_nothing_is_downloaded_without_acceptance(server: Server, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="licence"):
        fetch(server.url, tmp_path / "w.pth", accepted=False)
    assert server.ranges == []
    assert list(tmp_path.iterdir()) == []


def test_a_download_is_verified_and_what_was_accepted_is_recorded(server: Server, tmp_path: Path) -> None:
    digest = hashlib.sha256(CONTENT).hexdigest()
    target = fetch(server.url, tmp_path / "folder" / "w.pth", accepted=True, sha256=digest)
    assert target.read_bytes() == CONTENT
    record = json.loads((target.parent / "accepted.json").read_text())
    assert record["w.pth"] == {"url": server.url, "sha256": digest, "licence_accepted": True}
    assert sorted(path.name for path in target.parent.iterdir()) == ["accepted.json", "w.pth"]


def test_a_cut_download_resumes_where_it_stopped(server: Server, tmp_path: Path) -> None:
    server.cuts = 2
    target = fetch(server.url, tmp_path / "w.pth", accepted=True)
    assert target.read_bytes() == CONTENT
    assert server.ranges == [None, f"bytes={len(CONTENT) // 2}-", f"bytes={len(CONTENT) * 3 // 4}-"]


def test_a_later_call_continues_an_unfinished_download(server: Server, tmp_path: Path) -> None:
    (tmp_path / "w.pth.part").write_bytes(CONTENT[:1000])
    (tmp_path / "w.pth.part.etag").write_text('"1"')
    assert fetch(server.url, tmp_path / "w.pth", accepted=True).read_bytes() == CONTENT
    assert server.ranges == ["bytes=1000-"]


def test_a_file_that_changed_at_the_server_is_fetched_anew(server: Server, tmp_path: Path) -> None:
    (tmp_path / "w.pth.part").write_bytes(b"x" * 1000)
    (tmp_path / "w.pth.part.etag").write_text('"older"')
    assert fetch(server.url, tmp_path / "w.pth", accepted=True).read_bytes() == CONTENT


def test_an_unexpected_hash_removes_the_download(server: Server, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="SHA-256"):
        fetch(server.url, tmp_path / "w.pth", accepted=True, sha256="0" * 64)
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_always_cuts_leaves_the_part_and_says_so(server: Server, tmp_path: Path) -> None:
    server.cuts = 100
    with pytest.raises(WeightsError, match="run it again to continue"):
        fetch(server.url, tmp_path / "w.pth", accepted=True)
    assert (tmp_path / "w.pth.part").stat().st_size > len(CONTENT) // 2
    assert not (tmp_path / "w.pth").exists()


@pytest.mark.parametrize("url", ["ftp://example.org/w.pth", "w.pth", "javascript:1"])
def test_other_addresses_are_refused(url: str, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no http, https or file URL"):
        fetch(url, tmp_path / "w.pth", accepted=True)


def test_missing_files_and_dead_servers_are_reported(server: Server, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="404"):
        fetch(server.url.replace("weights", "other"), tmp_path / "w.pth", accepted=True)
    with pytest.raises(WeightsError, match="stopped"):
        fetch("http://127.0.0.1:9/w.pth", tmp_path / "w.pth", accepted=True)


def test_a_local_file_can_be_fetched(tmp_path: Path) -> None:
    source = tmp_path / "source.pth"
    source.write_bytes(CONTENT)
    assert fetch(source.as_uri(), tmp_path / "w.pth", accepted=True).read_bytes() == CONTENT


def test_status_names_files_licences_and_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "m.pth").write_bytes(b"123")
    rows = status(Mast3rConfig(weights=tmp_path / "m.pth"))
    assert [row.kind for row in rows] == ["mast3r", "cosplace"]
    assert "CC BY-NC-SA 4.0" in str(rows[0].licence)
    assert "unclear" in NEEDED[1].licence
    assert (rows[0].present, rows[0].size_bytes, rows[1].present) == (True, 3, False)


def test_synthesized_weights_pass_the_check_and_are_the_same_every_time(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="torch, an optional extra, is not installed")
    first, second = synthesize(tmp_path / "a"), synthesize(tmp_path / "b")
    checked = {kind: check(path) for kind, path in first.items()}
    assert (checked["mast3r"].kind, checked["mast3r"].network) == ("mast3r", "tiny")
    assert (checked["cosplace"].kind, checked["cosplace"].network) == ("cosplace", "ResNet18-64")
    assert checked["mast3r"].tensors == 369
    assert checked["cosplace"].parameters == 11_209_345
    for kind, path in second.items():
        assert check(path).model == checked[kind].model
        assert len(check(path).sha256) == 64


def test_check_refuses_what_is_no_checkpoint(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="torch, an optional extra, is not installed")
    from flocc_agent.perception.mast3r.checkpoint import BadCheckpoint

    (tmp_path / "w.pth").write_bytes(CONTENT)
    with pytest.raises(BadCheckpoint, match=r"w\.pth"):
        check(tmp_path / "w.pth")
