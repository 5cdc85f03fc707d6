"""Public data by name, from a server on this machine: checked, cached, resumed, refused."""

from __future__ import annotations

import hashlib
import socket
import struct
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.files import fetch
from mivol.files.fetch import DATA, DataSet, cache_folder, fetch_data, find_local_file, resolve_path

BODY = bytes(range(256)) * 1024


class Server:
    """Serves BODY.

    Attributes:
        breaks_after: bytes after which the connection is closed; None for never.
        knows_ranges: whether it answers a range by a part.
        asked: the ranges that were asked for, "" for all.
        errors: what went wrong while it answered. That a client breaks off is none of them.
    """

    def __init__(self) -> None:
        self.breaks_after: int | None = None
        self.knows_ranges, self.status, self.body = True, 200, BODY
        self.asked: list[str] = []
        self.errors: list[BaseException | None] = []
        this = self

        class Handler(BaseHTTPRequestHandler):
            timeout = 10

            def do_GET(self) -> None:
                wanted = self.headers.get("Range", "")
                this.asked.append(wanted)
                first = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and this.knows_ranges else 0
                self.send_response(206 if first else this.status)
                self.send_header("Content-Length", str(len(this.body) - first))
                self.end_headers()
                self.wfile.write(this.body[first:][: this.breaks_after])

            def log_message(self, *given: object) -> None:
                """Nothing."""

        class KeepingErrors(ThreadingHTTPServer):
            def handle_error(self, request: object, address: object) -> None:
                """Where socketserver prints a traceback."""
                if not isinstance(sys.exception(), ConnectionError):
                    this.errors.append(sys.exception())

        self.server = KeepingErrors(("127.0.0.1", 0), Handler)
        self.thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(fetch, "SECONDS", 10.0)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    one = Server()
    one.thread.start()
    yield one
    one.server.shutdown()
    one.server.server_close()
    one.thread.join(timeout=10)
    assert one.errors == []


@pytest.fixture
def data(server: Server) -> DataSet:
    url = f"http://127.0.0.1:{server.server.server_port}/a.vol"
    return DataSet("body", "bytes", url, "kind/a.vol", len(BODY), hashlib.sha256(BODY).hexdigest(), "CC0")


def test_the_test_server_is_quiet_about_closed_connections(server: Server, capfd: pytest.CaptureFixture) -> None:
    """``fetch_data`` closes the connection to a server with too many bytes; socketserver would print a traceback."""
    server.body = bytes(1 << 26)  # more than a socket holds: the server is still writing when the client leaves
    server.server.daemon_threads = False  # so that closing waits for the thread that answers
    linger = struct.pack("hh" if sys.platform == "win32" else "ii", 1, 0)  # 0 s: the connection ends by a reset
    with socket.create_connection(("127.0.0.1", server.server.server_port)) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        client.sendall(b"GET /a.vol HTTP/1.0\r\n\r\n")
        client.recv(1)
    server.server.shutdown()
    server.server.server_close()
    assert capfd.readouterr().err == ""


def test_a_data_set_is_downloaded_once(server: Server, data: DataSet, tmp_path: Path) -> None:
    seen: list[int] = []
    path = fetch_data(data, tmp_path, seen.append)
    assert path == tmp_path / "kind/a.vol"
    assert path.read_bytes() == BODY
    assert seen[-1] == len(BODY)
    assert fetch_data(data, tmp_path) == path
    assert server.asked == [""]
    path.write_bytes(b"damaged")
    assert fetch_data(data, tmp_path).read_bytes() == BODY


@pytest.mark.parametrize("knows_ranges", [True, False])
def test_an_interrupted_download_resumes(server: Server, data: DataSet, tmp_path: Path, knows_ranges: bool) -> None:
    """The second call requests the missing bytes; a server without ranges sends the whole file again."""
    server.breaks_after, server.knows_ranges = 100000, knows_ranges
    assert_refused("100000 of 262144 bytes; call again to resume the download", fetch_data, data, tmp_path)
    assert not (tmp_path / "kind/a.vol").exists()
    server.breaks_after = None
    assert fetch_data(data, tmp_path).read_bytes() == BODY
    assert server.asked == ["", "bytes=100000-"]
    assert [path.name for path in (tmp_path / "kind").iterdir()] == ["a.vol"]


def test_a_wrong_hash_is_refused_and_deleted(server: Server, data: DataSet, tmp_path: Path) -> None:
    assert_refused("the download was deleted", fetch_data, replace(data, sha256="0" * 64), tmp_path)
    server.body = BODY * 50
    assert_refused("the download was deleted", fetch_data, data, tmp_path)
    assert list((tmp_path / "kind").iterdir()) == []


def test_a_larger_file_does_not_fill_the_disk(server: Server, data: DataSet, tmp_path: Path) -> None:
    """Reading ends with the chunk that exceeds the expected size."""
    seen: list[int] = []
    server.body = BODY * 50
    with pytest.raises(MivolError):
        fetch_data(data, tmp_path, seen.append)
    assert seen[-1] <= len(BODY) + fetch.CHUNK


def test_an_unreachable_server_is_reported(server: Server, data: DataSet, tmp_path: Path) -> None:
    server.status = 404
    assert_refused(r"could not be fetched \(Not Found\) after 0 of", fetch_data, data, tmp_path)
    assert_refused("could not be fetched", fetch_data, replace(data, url="http://127.0.0.1:9/a.vol"), tmp_path)


def test_a_path_may_name_a_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MIVOL_DATA", raising=False)
    monkeypatch.setenv("MIVOL_CACHE", str(tmp_path / "cache"))
    assert resolve_path(tmp_path, "a.vol") == tmp_path / "a.vol"
    assert find_local_file("smoke") is None
    assert_refused('"mivol fetch smoke"', resolve_path, tmp_path, "data:smoke")
    assert_refused('did you mean "smoke"', resolve_path, tmp_path, "data:smok")
    for variable, folder in (("MIVOL_CACHE", "cache"), ("MIVOL_DATA", "beside")):
        monkeypatch.setenv(variable, str(tmp_path / folder))
        there = tmp_path / folder / DATA["smoke"].path
        there.parent.mkdir(parents=True)
        there.touch()
        assert resolve_path(tmp_path, "data:smoke") == there


def test_the_cache_is_in_the_folder_of_the_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MIVOL_CACHE", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "platform", "linux")
        assert cache_folder() == tmp_path / ".cache" / "mivol"
        patch.setattr(sys, "platform", "darwin")
        assert cache_folder() == tmp_path / "Library" / "Caches" / "mivol"
    monkeypatch.setenv("MIVOL_CACHE", str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine"


@pytest.mark.parametrize("name", DATA)
def test_a_data_set_is_a_file_at_a_fixed_commit(name: str) -> None:
    one = DATA[name]
    assert one.url.startswith("https://raw.githubusercontent.com/")
    assert any(len(part) == 40 and set(part) <= set("0123456789abcdef") for part in one.url.split("/"))
    assert one.licence in one.describe()


@pytest.mark.parametrize("name", DATA)
def test_a_data_set_has_the_size_and_hash_of_the_table(name: str, data_dir: Path) -> None:
    found = (data_dir / DATA[name].path).read_bytes()
    assert (len(found), hashlib.sha256(found).hexdigest()) == (DATA[name].size, DATA[name].sha256)
