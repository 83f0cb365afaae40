import errno
import io
import json
import os
import shutil
import threading
import zipfile
from collections import namedtuple
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import product
from unittest.mock import patch

import pytest

from tests.refusals import assert_refused
from xplanes.errors import SceneError
from xplanes.files import StorageError
from xplanes.tools import download as download_module
from xplanes.tools import download as fetch_module
from xplanes.tools.download import DNERF_URL, TRAIN_VIEWS, download_dnerf

VIEWS = {name: count // 25 for name, count in TRAIN_VIEWS.items()}
"""Numbers of training views in these tests, but for those that want the published ones."""

COPIES = 60
"""How often the text of an image repeats, for an archive of some size."""


def make_archive(*, top="data/", skip=(), extra=(), train_views=None, held_out=2):
    """A zip in the shape of the D-NeRF archive, with some text for every image."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for scene, train in ({**VIEWS, **(train_views or {})}).items():
            for split, count in (("train", train), ("val", held_out), ("test", held_out)):
                frames = [{"file_path": f"./{split}/r_{i:03}"} for i in range(count)]
                files = [f"{scene}/{split}/r_{i:03}.png" for i in range(count)]
                listing = f"{scene}/transforms_{split}.json"
                for name, text in [
                    (listing, json.dumps({"frames": frames})),
                    *((file, file * COPIES) for file in files),
                ]:
                    if name not in skip:
                        archive.writestr(top + name, text)
        archive.writestr("__MACOSX/data/lego/._r_000.png", "junk")
        for name in extra:
            archive.writestr(name, "junk")
    return content.getvalue()


@pytest.fixture(scope="module")
def archive():
    return make_archive()


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        server.requests.append(dict(self.headers))
        if server.status != 200:
            self.send_error(server.status)
            return
        body, start = server.content, 0
        asked = self.headers.get("Range")
        unchanged = self.headers.get("If-Range") == server.etag or server.ignores_if_range
        if asked and server.ranges and unchanged:
            start = int(asked.removeprefix("bytes=").removesuffix("-"))
            if start >= len(body):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(body)}")
                self.end_headers()
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
        else:
            self.send_response(200)
        if server.etag:
            self.send_header("ETag", server.etag)
        if server.sends_length:
            self.send_header("Content-Length", str(len(body) - start))
        self.send_header("Content-Type", server.content_type)
        self.end_headers()
        limit = server.limits.pop(0) if server.limits else None
        self.wfile.write(body[start:][:limit])
        self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture
def server(archive, monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setattr(fetch_module, "PAUSE_SECONDS", 0.01)
    monkeypatch.setattr(download_module, "TRAIN_VIEWS", VIEWS)
    monkeypatch.setattr(download_module, "TEST_VIEWS", 2)
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.content = archive
        server.requests = []
        server.limits = []  # bytes after which each answer is cut off
        server.status = 200
        server.etag = '"one"'
        server.ranges = True
        server.ignores_if_range = False
        server.sends_length = True
        server.content_type = "application/zip"
        server.url = f"http://127.0.0.1:{server.server_port}/data.zip"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def download(root, server, **arguments):
    lines = []
    with patch.object(download_module, "say", lines.append):
        result = download_dnerf(root, url=server.url, **arguments)
    return result, lines


def error(root, server, **arguments):
    call = partial(download, root, server, **arguments)
    return assert_refused(SceneError, "", call, arguments)


def assert_complete(root, views=VIEWS, case=None):
    assert sorted(path.name for path in root.iterdir()) == sorted(views), case
    for scene, count in views.items():
        assert len(list((root / scene / "train").iterdir())) == count, case
        assert (root / scene / "val" / "r_001.png").read_text() == (
            f"{scene}/val/r_001.png" * COPIES
        ), case


def scenes_in(root):
    return [path.name for path in root.iterdir() if path.is_dir()]


def test_downloads_and_unpacks_all_scenes(tmp_path, server, monkeypatch):
    monkeypatch.setattr(download_module, "TRAIN_VIEWS", TRAIN_VIEWS)
    monkeypatch.setattr(download_module, "TEST_VIEWS", 20)
    server.content = make_archive(train_views=TRAIN_VIEWS, held_out=20)
    root = tmp_path / "data" / "dnerf"
    result, lines = download(root, server)
    assert result == root
    assert_complete(root, TRAIN_VIEWS)
    assert server.url in lines[0]
    assert "lego" in lines[-1]
    assert not any("Note" in line for line in lines)


def test_nothing_is_fetched_when_all_is_there(tmp_path, server):
    download(tmp_path, server)
    _, lines = download(tmp_path, server)
    assert len(server.requests) == 1
    assert "already" in lines[0]


def test_scenes_already_there_are_kept(tmp_path, server):
    (tmp_path / "lego").mkdir()
    (tmp_path / "lego" / "transforms_train.json").write_text("mine")
    download(tmp_path, server)
    assert (tmp_path / "lego" / "transforms_train.json").read_text() == "mine"
    assert sorted(scenes_in(tmp_path)) == sorted(VIEWS)


def test_a_folder_in_the_way_is_not_touched(tmp_path, server):
    (tmp_path / "lego").mkdir()
    (tmp_path / "lego" / "notes.txt").write_text("mine")
    message = error(tmp_path, server)
    assert str(tmp_path / "lego") in message
    assert "Move it" in message
    assert not server.requests


def part_of(root, content, **note):
    """A download that was cut off, and what was noted of it."""
    part = root / "dnerf.zip.part"
    part.write_bytes(content)
    part.with_name("dnerf.zip.part.json").write_text(json.dumps(note))


@pytest.mark.parametrize(
    ("changes", "asked"),
    [
        ({}, "bytes=50000-"),
        ({"ranges": False}, "bytes=50000-"),
        ({"etag": None}, None),
        ({"etag": 'W/"weak"'}, None),
        ({"sends_length": False, "limits": []}, None),
        ({"content": make_archive(top="", held_out=3)}, "bytes=50000-"),
    ],
    ids=["sound", "no ranges", "no version", "weak version", "no length", "other views"],
)
def test_a_cut_is_made_up_for_whatever_the_server_can_do(tmp_path, server, changes, asked):
    server.limits = [50_000]
    for name, value in changes.items():
        setattr(server, name, value)
    _, lines = download(tmp_path, server)
    assert_complete(tmp_path)
    ranges = [request.get("Range") for request in server.requests]
    assert ranges == [None, asked][: len(ranges)]
    assert any("trying again" in line for line in lines) == (len(ranges) > 1)
    noted = sum("3 test views; 2 are usual" in line for line in lines)
    assert noted == (len(VIEWS) if "content" in changes else 0)


def test_a_part_of_unknown_origin_is_not_continued(tmp_path, server):
    part_of(tmp_path, b"old", url="elsewhere", validator="one")
    download(tmp_path, server)
    assert "Range" not in server.requests[0]
    assert_complete(tmp_path)


def test_resumes_at_the_next_call_after_a_cut(tmp_path, server, monkeypatch):
    monkeypatch.setattr(fetch_module, "ATTEMPTS", 1)
    server.limits = [50_000]
    message = error(tmp_path, server)
    assert "ended after 0.1 of" in message
    assert "dnerf.zip.part" in message
    assert scenes_in(tmp_path) == []
    download(tmp_path, server)
    assert server.requests[1]["Range"] == "bytes=50000-"
    assert server.requests[1]["If-Range"] == '"one"'
    assert_complete(tmp_path)


def test_a_complete_part_is_not_fetched_again(tmp_path, server):
    part_of(tmp_path, server.content, url=server.url, validator='"one"')
    download(tmp_path, server)
    assert len(server.requests) == 1
    assert_complete(tmp_path)


def test_a_changed_file_is_fetched_from_its_start(tmp_path, server):
    for ignores_if_range, size in product((False, True), (1000, 10_000_000)):
        case = f"If-Range ignored: {ignores_if_range}, {size} bytes"
        root = tmp_path / f"{ignores_if_range} {size}"
        root.mkdir()
        part_of(root, b"old" * (size // 3), url=server.url, validator='"zero"')
        server.ignores_if_range = ignores_if_range
        server.requests.clear()
        download(root, server)
        assert "Range" in server.requests[0], case
        assert_complete(root, case=case)


def test_damaged_archives_leave_no_scene(tmp_path, server):
    whole = server.content
    server.content = whole[:-100]
    message = error(tmp_path, server)
    assert "dnerf.zip" in message
    assert "damaged" in message
    assert list(tmp_path.iterdir()) == []

    flipped = bytearray(whole)
    name = b"trex/test/r_001.png"
    flipped[whole.index(name, whole.index(b"data/" + name) + 10)] ^= 0xFF
    server.content = bytes(flipped)
    message = error(tmp_path, server)
    assert "CRC" in message
    assert "r_001.png" in message
    assert list(tmp_path.iterdir()) == []


def test_members_that_leave_the_folder(tmp_path, server):
    root = tmp_path / "root"
    for name in ("../evil", "data/../../evil", "/evil", "data\\..\\evil", "C:/evil"):
        server.content = make_archive(extra=[name])
        message = error(root, server)
        assert "evil" in message, name
        assert "leads out" in message, name
        assert list(root.iterdir()) == [], name
        assert [path.name for path in tmp_path.iterdir()] == ["root"], name


def test_incomplete_archive_leaves_no_scene(tmp_path, server):
    for changes, words in (
        ({"skip": ["trex/transforms_val.json"]}, "trex/transforms_val.json is missing"),
        ({"skip": ["hook/test/r_000.png"]}, "hook lacks ./test/r_000.png"),
        ({"train_views": {"lego": 1}}, "lego has 1 training views instead of 2"),
    ):
        server.content = make_archive(**changes)
        assert words in error(tmp_path, server), changes
        assert list(tmp_path.iterdir()) == [], changes


def test_not_found_names_the_address_and_the_way_by_hand(tmp_path, server):
    server.status = 404
    message = error(tmp_path, server)
    assert f"{server.url} answered 404" in message
    assert DNERF_URL in message
    assert str(tmp_path / "dnerf.zip") in message
    assert "data=demo" in message
    assert len(server.requests) == 1


def test_web_page_instead_of_the_archive(tmp_path, server):
    server.content = b"<html>This link was disabled</html>"
    server.content_type = "text/html; charset=utf-8"
    assert "web page" in error(tmp_path, server)
    assert list(tmp_path.iterdir()) == []


def test_addresses_that_cannot_be_reached(tmp_path, server):
    server.url = "file:///etc/hostname"
    assert "not an http or https address" in error(tmp_path, server)
    server.url = "http://127.0.0.1:9/data.zip"
    message = error(tmp_path, server)
    assert "cannot be reached" in message
    assert "by hand" in message
    assert str(tmp_path / "dnerf.zip") in message


def test_archive_fetched_by_hand_is_used_and_kept(tmp_path, server):
    (tmp_path / "dnerf.zip").write_bytes(server.content)
    _, lines = download(tmp_path, server)
    assert "already" in lines[0]
    assert not server.requests
    assert sorted(scenes_in(tmp_path)) == sorted(VIEWS)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "dnerf.zip").write_bytes(b"no zip")
    assert "Replace it or delete it" in error(tmp_path / "other", server)
    assert (tmp_path / "dnerf.zip").exists()
    assert (tmp_path / "other" / "dnerf.zip").exists()


def test_full_disk(tmp_path, server, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 0, len(server.content)))
    message = error(tmp_path, server)
    assert "free space" in message
    assert str(tmp_path) in message
    assert scenes_in(tmp_path) == []
    # An archive fetched by hand has to be unpacked too.
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 0, 1000))
    (tmp_path / "dnerf.zip").write_bytes(server.content)
    assert "free space" in error(tmp_path, server)
    assert scenes_in(tmp_path) == []


def test_a_web_page_in_between_keeps_what_was_fetched(tmp_path, server, monkeypatch):
    monkeypatch.setattr(fetch_module, "ATTEMPTS", 1)
    server.limits = [50_000]
    error(tmp_path, server)
    content, server.content = server.content, b"<html>Busy</html>"
    kind, server.content_type, server.ranges = server.content_type, "text/html", False
    assert "web page" in error(tmp_path, server)
    assert (tmp_path / "dnerf.zip.part").stat().st_size == 50_000
    server.content, server.content_type, server.ranges = content, kind, True
    download(tmp_path, server)
    assert server.requests[-1]["Range"] == "bytes=50000-"
    assert_complete(tmp_path)


def test_a_disk_that_refuses_is_said_in_words(tmp_path, server, monkeypatch):
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(StorageError, match="A file stands where a folder should be"):
            download(root, server)

    def full(line: str) -> None:
        if line.startswith("Downloading"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(download_module, "say", full)
    with pytest.raises(StorageError, match=r"cannot be written: No space left.*Free some space"):
        download_dnerf(tmp_path / "root", url=server.url)
