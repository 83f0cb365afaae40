import errno
import io
import json
import os
import shutil
import zipfile
from collections import namedtuple
from functools import partial
from http.server import BaseHTTPRequestHandler
from unittest.mock import patch

import pytest

from tests.local_server import serving
from tests.refusals import assert_refused
from xplanes.errors import SceneError
from xplanes.files import StorageError
from xplanes.tools import download as module
from xplanes.tools.download import DNERF_URL, TRAIN_VIEWS, download_dnerf

VIEWS = {name: count // 25 for name, count in TRAIN_VIEWS.items()}
"""Numbers of training views in these tests, but for those that want the published ones."""

BY_HAND = (DNERF_URL, "by hand", "{root}/dnerf.zip", "data=demo")
"""What a message says where the archive cannot be fetched."""

COPIES = 60
"""How often the text of an image repeats, for an archive of some size."""


def make_archive(*, top="data/", skip=(), extra=(), train_views=None, held_out=2):
    """A zip in the shape of the D-NeRF archive, with some text for every image."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for scene, train in {**VIEWS, **(train_views or {})}.items():
            for split, count in (("train", train), ("val", held_out), ("test", held_out)):
                names = [f"{split}/r_{i:03}" for i in range(count)]
                listed = {"frames": [{"file_path": f"./{name}"} for name in names]}
                files = {f"{scene}/transforms_{split}.json": json.dumps(listed)}
                files |= {f"{scene}/{name}.png": f"{scene}/{name}.png" * COPIES for name in names}
                for name in filter(lambda name: name not in skip, files):
                    archive.writestr(top + name, files[name])
        for name in ("__MACOSX/data/lego/._r_000.png", *extra):
            archive.writestr(name, "junk")
    return content.getvalue()


@pytest.fixture(scope="module")
def archive():
    return make_archive()


class Handler(BaseHTTPRequestHandler):
    """Answers with an archive, or as its attributes say, which tests change."""

    content: bytes
    requests: list
    limits: list  # Bytes after which each answer is cut off.
    status = 200
    ranges = True
    sends_length = True
    content_type = "application/zip"

    def do_GET(self):
        self.requests.append(dict(self.headers))
        if self.status != 200:
            self.send_error(self.status)
            return
        code, start, size = 200, 0, len(self.content)
        headers = {"Content-Type": self.content_type}
        asked = self.headers.get("Range")
        if asked and self.ranges:
            start = int(asked.removeprefix("bytes=").removesuffix("-"))
            code, served = (206, f"{start}-{size - 1}") if start < size else (416, "*")
            headers["Content-Range"] = f"bytes {served}/{size}"
        if self.sends_length:
            headers["Content-Length"] = str(max(0, size - start))
        self.send_response(code)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(self.content[start:][: self.limits.pop(0) if self.limits else None])
        self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture
def server(archive, monkeypatch):
    monkeypatch.setattr(module, "PAUSE_SECONDS", 0.01)
    monkeypatch.setattr(module, "TRAIN_VIEWS", VIEWS)
    monkeypatch.setattr(module, "TEST_VIEWS", 2)
    handler = type("Server", (Handler,), {"content": archive, "requests": [], "limits": []})
    with serving(handler, monkeypatch) as address:
        handler.url = f"{address}/data.zip"
        yield handler


def download(root, server):
    """Download, and return what was said."""
    lines = []
    with patch.object(module, "say", lines.append):
        assert download_dnerf(root, url=server.url) == root
    return lines


def error(root, server):
    return assert_refused(SceneError, "", partial(download, root, server), server.url)


def assert_complete(root, views=VIEWS):
    assert sorted(path.name for path in root.iterdir()) == sorted(views)
    for scene, count in views.items():
        assert len(list((root / scene / "train").iterdir())) == count
        shown = (root / scene / "val" / "r_001.png").read_text()
        assert shown == f"{scene}/val/r_001.png" * COPIES


def scenes_in(root):
    return sorted(path.name for path in root.iterdir() if path.is_dir())


def test_downloads_and_unpacks_all_scenes(tmp_path, server, monkeypatch):
    monkeypatch.setattr(module, "TRAIN_VIEWS", TRAIN_VIEWS)
    monkeypatch.setattr(module, "TEST_VIEWS", 20)
    server.content = make_archive(train_views=TRAIN_VIEWS, held_out=20)
    root = tmp_path / "data" / "dnerf"
    lines = download(root, server)
    assert_complete(root, TRAIN_VIEWS)
    assert server.url in lines[0]
    assert "lego" in lines[-1]
    assert not any("Note" in line for line in lines)
    # All is there now.
    assert "already" in download(root, server)[0]
    assert len(server.requests) == 1


def test_scenes_already_there_are_kept(tmp_path, server):
    (tmp_path / "lego").mkdir()
    (tmp_path / "lego" / "transforms_train.json").write_text("mine")
    download(tmp_path, server)
    assert (tmp_path / "lego" / "transforms_train.json").read_text() == "mine"
    assert scenes_in(tmp_path) == sorted(VIEWS)


def test_a_folder_in_the_way_is_not_touched(tmp_path, server):
    (tmp_path / "lego").mkdir()
    (tmp_path / "lego" / "notes.txt").write_text("mine")
    message = error(tmp_path, server)
    assert str(tmp_path / "lego") in message
    assert "Move it" in message
    assert not server.requests


@pytest.mark.parametrize(
    ("changes", "asked"),
    [
        ({}, "bytes=50000-"),
        ({"ranges": False}, "bytes=50000-"),
        ({"sends_length": False, "limits": []}, None),
        ({"content": make_archive(top="", held_out=3)}, "bytes=50000-"),
    ],
    ids=["sound", "no ranges", "no length", "other views"],
)
def test_a_cut_is_made_up_for_whatever_the_server_can_do(tmp_path, server, changes, asked):
    with patch.multiple(server, **{"limits": [50_000]} | changes):
        lines = download(tmp_path, server)
    assert_complete(tmp_path)
    ranges = [request.get("Range") for request in server.requests]
    assert ranges == [None, asked][: len(ranges)]
    assert any("trying again" in line for line in lines) == (len(ranges) > 1)
    noted = sum("3 test views; 2 are usual" in line for line in lines)
    assert noted == (len(VIEWS) if "content" in changes else 0)


@pytest.mark.parametrize(("size", "requests"), [(None, 1), (10_000_000, 2)])
def test_a_part_that_is_whole_serves_and_one_that_is_larger_does_not(
    tmp_path, server, size, requests
):
    part = tmp_path / "dnerf.zip.part"
    part.write_bytes(server.content if size is None else bytes(size))
    download(tmp_path, server)
    assert len(server.requests) == requests
    assert_complete(tmp_path)


def test_a_part_of_another_file_is_found_out_and_leaves_nothing(tmp_path, server):
    (tmp_path / "dnerf.zip.part").write_bytes(bytes(60_000))
    assert "It was deleted: try again" in error(tmp_path, server)
    assert list(tmp_path.iterdir()) == []
    download(tmp_path, server)
    assert_complete(tmp_path)


@pytest.mark.parametrize("page_in_between", [False, True])
def test_a_call_after_a_cut_goes_on(tmp_path, server, monkeypatch, page_in_between):
    monkeypatch.setattr(module, "ATTEMPTS", 1)
    server.limits = [50_000]
    message = error(tmp_path, server)
    assert "ended after 0.1 of" in message
    assert "dnerf.zip.part" in message
    assert scenes_in(tmp_path) == []
    if page_in_between:
        page = {"content": b"<html>Busy</html>", "content_type": "text/html", "ranges": False}
        with patch.multiple(server, **page):
            assert "web page" in error(tmp_path, server)
        assert (tmp_path / "dnerf.zip.part").stat().st_size == 50_000
    download(tmp_path, server)
    assert server.requests[-1]["Range"] == "bytes=50000-"
    assert_complete(tmp_path)


def flipped(content):
    """An archive with a wrong bit in an image."""
    name, changed = b"trex/test/r_001.png", bytearray(content)
    changed[content.index(name, content.index(b"data/" + name) + 10)] ^= 0xFF
    return bytes(changed)


REFUSED = [
    ({"content": make_archive()[:-100]}, ["dnerf.zip", "damaged"]),
    ({"content": flipped(make_archive())}, ["CRC", "r_001.png"]),
    *(
        ({"content": make_archive(**changes)}, words)
        for changes, *words in (
            ({"skip": ["trex/transforms_val.json"]}, "trex/transforms_val.json is missing"),
            ({"skip": ["hook/test/r_000.png"]}, "hook lacks ./test/r_000.png"),
            ({"train_views": {"lego": 1}}, "lego has 1 training views instead of 2"),
            ({"extra": ["../evil"]}, "evil", "leads out"),
            ({"extra": ["data/../../evil"]}, "evil", "leads out"),
            ({"extra": ["/evil"]}, "evil", "leads out"),
            ({"extra": ["data\\..\\evil"]}, "evil", "leads out"),
            ({"extra": ["C:/evil"]}, "evil", "leads out"),
        )
    ),
    ({"content": b"<html>", "content_type": "text/html; charset=utf-8"}, ["web page", *BY_HAND]),
    ({"status": 404}, ["{url} answered 404", *BY_HAND]),
    ({"url": "http://127.0.0.1:9/data.zip"}, ["{url} cannot be reached", *BY_HAND]),
    ({"url": "file:///etc/hostname"}, ["{url} is not an http or https address", *BY_HAND]),
]


@pytest.mark.parametrize(("changes", "words"), REFUSED, ids=[words[0] for _, words in REFUSED])
def test_what_cannot_be_used_leaves_nothing_and_is_said(tmp_path, server, changes, words):
    root = tmp_path / "root"
    with patch.multiple(server, **changes):
        message = error(root, server)
        for text in words:
            assert text.format(url=server.url, root=root) in message
    assert list(root.iterdir()) == []
    assert list(tmp_path.iterdir()) == [root]
    assert len(server.requests) == ("url" not in changes)


def test_archive_fetched_by_hand_is_used_and_kept(tmp_path, server):
    (tmp_path / "dnerf.zip").write_bytes(server.content)
    assert "already" in download(tmp_path, server)[0]
    assert not server.requests
    assert scenes_in(tmp_path) == sorted(VIEWS)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "dnerf.zip").write_bytes(b"no zip")
    assert "Replace it or delete it" in error(tmp_path / "other", server)
    assert (tmp_path / "dnerf.zip").exists()
    assert (tmp_path / "other" / "dnerf.zip").exists()


def test_full_disk(tmp_path, server, monkeypatch):
    usage = namedtuple("usage", "total used free")
    # An archive fetched by hand has to be unpacked too.
    for free, by_hand in ((len(server.content), False), (1000, True)):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: usage(10, 0, free))
        if by_hand:
            (tmp_path / "dnerf.zip").write_bytes(server.content)
        message = error(tmp_path, server)
        assert "free space" in message
        assert str(tmp_path) in message
        assert scenes_in(tmp_path) == []


def test_a_disk_that_refuses_is_said_in_words(tmp_path, server, monkeypatch):
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(StorageError, match="A file is in the place of a folder"):
            download(root, server)

    def full(line: str) -> None:
        if line.startswith("Downloading"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module, "say", full)
    with pytest.raises(StorageError, match=r"cannot be written: No space left.*Free some space"):
        download_dnerf(tmp_path / "root", url=server.url)
