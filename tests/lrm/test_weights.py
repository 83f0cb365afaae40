"""Weights come from a file, the cache or the hub; a hub of our own stands in for it."""

import hashlib
import http.server
import json
import time
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file

from tests.local_server import serving
from tests.lrm.reduced import published_shapes, reduced
from xplanes.lrm import LRMError
from xplanes.lrm.config import parse_config, published_config
from xplanes.lrm.weights import WeightSource, answers, find_weights, load_weights, read_config

SOURCE = WeightSource(
    architecture="openlrm-small-1.1",
    repository="somebody/small-1.1",
    file="model.safetensors",
    revision="main",
    licence="CC-BY-NC-4.0",
    megabytes=446,
    weights=None,
    config=None,
)
COMMIT = "0123456789abcdef0123456789abcdef01234567"
NOWHERE = "http://127.0.0.1:9"


def load_source(source, *, announce=print, **options):
    """Find weights and load them."""
    path = find_weights(source, announce=announce, **options)
    return load_weights(source, path, announce=announce)


class Hub(http.server.BaseHTTPRequestHandler):
    """Answers as the hub does for one file."""

    content = b""

    def _answer(self, *, body):
        type(self).requests.append((self.command, self.path))
        places = (f"resolve/{revision}/{SOURCE.file}" for revision in (SOURCE.revision, COMMIT))
        if self.path not in [f"/{SOURCE.repository}/{place}" for place in places]:
            self.send_response(404)
            self.send_header("X-Error-Code", "RepoNotFound")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.content)))
        self.send_header("ETag", f'"{hashlib.sha256(self.content).hexdigest()}"')
        self.send_header("X-Repo-Commit", COMMIT)
        self.end_headers()
        if body:
            self.wfile.write(self.content)

    def do_HEAD(self):
        self._answer(body=False)

    def do_GET(self):
        self._answer(body=True)

    def log_message(self, *_):
        pass


@pytest.fixture(autouse=True)
def online(monkeypatch):
    """Downloads are allowed, whatever the environment says; the hub reads it when imported."""
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)


@pytest.fixture
def hub(monkeypatch):
    """Address of a hub on this machine, and what it was asked for."""
    handler = type("Handler", (Hub,), {"requests": []})
    with serving(handler, monkeypatch) as address:
        yield address, handler


@pytest.fixture
def small(tmp_path):
    """A reduced checkpoint with its configuration beside it."""
    settings, state = reduced("openlrm-1.1")
    folder = tmp_path / "published"
    folder.mkdir()
    save_file(state, folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(settings))
    return folder


def test_download_happens_once(hub, small, tmp_path):
    address, handler = hub
    handler.content = (small / "model.safetensors").read_bytes()
    lines = []
    options = {"announce": lines.append, "endpoint": address, "cache": tmp_path / "cache"}
    path = find_weights(SOURCE, **options)
    assert path.read_bytes() == handler.content
    assert len(lines) == 1
    assert "446 MB" in lines[0]
    assert "CC-BY-NC-4.0" in lines[0]
    handler.requests.clear()
    assert find_weights(SOURCE, **options) == path
    assert find_weights(SOURCE, **{**options, "endpoint": NOWHERE}) == path
    assert not handler.requests
    assert len(lines) == 1


def test_downloaded_weights_of_other_sizes_need_their_configuration(hub, small, tmp_path):
    address, handler = hub
    handler.content = (small / "model.safetensors").read_bytes()
    options = {"announce": lambda line: None, "endpoint": address, "cache": tmp_path / "cache"}
    model = load_source(replace(SOURCE, config=str(small / "config.json")), **options)
    assert model.config.channels == 6
    with pytest.raises(LRMError, match=r"does not fit openlrm-small-1\.1"):
        load_source(SOURCE, **options)


def test_offline_says_everything_at_once(tmp_path):
    start = time.monotonic()
    with pytest.raises(LRMError) as caught:
        find_weights(SOURCE, endpoint=NOWHERE, cache=tmp_path)
    assert time.monotonic() - start < 1
    for part in ("446 MB", "CC-BY-NC-4.0", SOURCE.url, "lrm.weights=FILE", "lrm=none", NOWHERE):
        assert part in str(caught.value)


def test_silent_server_is_given_up_in_time(monkeypatch):
    def hang(*_):
        time.sleep(2)
        raise OSError

    monkeypatch.setattr("socket.create_connection", hang)
    monkeypatch.setattr("xplanes.lrm.weights.PATIENCE_SECONDS", 0.1)
    start = time.monotonic()
    assert not answers("https://hub.example")
    assert time.monotonic() - start < 1


@pytest.mark.parametrize(
    ("proxy", "target"), [("http_proxy", "http://192.0.2.1"), ("all_proxy", "https://192.0.2.1")]
)
def test_a_proxy_is_asked_instead(hub, monkeypatch, proxy, target):
    address, _ = hub
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(proxy, address)
    monkeypatch.setenv("no_proxy", "")
    assert answers(target)


def test_forbidden_download(monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(LRMError, match=r"HF_HUB_OFFLINE.*lrm\.weights=FILE"):
        find_weights(SOURCE, cache=tmp_path)


def test_absent_repository(hub, tmp_path):
    source = replace(SOURCE, repository="somebody/else")
    with pytest.raises(LRMError, match=r"somebody/else.*cannot be downloaded.*lrm=none"):
        find_weights(source, announce=lambda line: None, endpoint=hub[0], cache=tmp_path)


def test_local_file_needs_no_hub(small, monkeypatch):
    monkeypatch.setattr("xplanes.lrm.weights.require", lambda *_, **__: 1 / 0)
    source = replace(SOURCE, weights=str(small / "model.safetensors"))
    assert find_weights(source) == small / "model.safetensors"
    with pytest.raises(LRMError, match=r"lrm\.weights=.*absent.*446 MB"):
        find_weights(replace(SOURCE, weights=str(small / "absent")))


def test_local_file_brings_its_configuration(small):
    lines = []
    source = replace(SOURCE, weights=str(small / "model.safetensors"))
    assert load_source(source, announce=lines.append).config.channels == 6
    assert "config.json" in lines[0]
    (small / "config.json").unlink()
    with pytest.raises(LRMError, match="fits no published model"):
        load_source(source)


def test_another_published_size_is_refused_whatever_lies_beside(tmp_path, monkeypatch):
    settings = published_config("openlrm-base-1.1")
    (tmp_path / "config.json").write_text(json.dumps(settings))
    (tmp_path / "model.safetensors").touch()
    state = published_state(settings)
    monkeypatch.setattr("xplanes.lrm.checkpoint.read_weights", lambda path: (state, {}))
    with pytest.raises(LRMError, match=r"It fits openlrm-base-1\.1 \(lrm=base\)"):
        load_source(replace(SOURCE, weights=str(tmp_path / "model.safetensors")))


def published_state(settings):
    shapes = published_shapes(parse_config(settings))
    return {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


def test_configuration_files(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("cond_image_size: 96\ntokenizer:\n  plane_size: 6\n")
    assert read_config(path)["tokenizer"] == {"plane_size": 6}
    for content in ("[1, 2", "just words", "!!python/object/apply:print [a]"):
        path.write_text(content)
        with pytest.raises(LRMError, match=r"config\.yaml"):
            read_config(path)
    with pytest.raises(LRMError, match="absent"):
        read_config(tmp_path / "absent.json")
