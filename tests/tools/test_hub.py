"""Runs on a hub: the real client uploads to a server of our own and reads them back."""

import base64
import functools
import hashlib
import http.server
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from tests.local_server import serving
from tests.training.runs import metrics, status
from xplanes.cli import main
from xplanes.errors import ConfigError
from xplanes.tools.hub import fetch, model_card, push
from xplanes.tools.runs import load_run

COMMIT = "0123456789abcdef0123456789abcdef01234567"
NOWHERE = "http://127.0.0.1:9"


class Hub(http.server.BaseHTTPRequestHandler):
    """A hub with one repository, which begins to exist when it is made."""

    files: dict[str, bytes]
    requests: list[tuple[str, str, str | None]]
    name: str | None

    def _answer(self, body: Any, status: int = 200, **headers: str) -> None:
        if not isinstance(body, bytes):
            body = json.dumps(body).encode()
            headers["Content_Type"] = "application/json"
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _missing(self) -> None:
        self._answer({"error": "not found"}, 404, X_Error_Code="RepoNotFound")

    def do_POST(self) -> None:
        hub, body = type(self), self.rfile.read(int(self.headers["Content-Length"]))
        hub.requests.append(("POST", self.path, self.headers.get("Authorization")))
        path = self.path.partition("?")[0]
        if self.headers.get("Authorization") != "Bearer hf_of_a_test":
            self._answer({"error": "unauthorized"}, 401)
        elif path == "/api/repos/create":
            asked = json.loads(body)
            hub.name = f"{asked.get('organization', 'somebody')}/{asked['name']}"
            self._answer({"url": f"http://{self.headers['Host']}/{hub.name}"})
        elif path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif path.endswith("/preupload/main"):
            asked = [each["path"] for each in json.loads(body)["files"]]
            regular = {"uploadMode": "regular", "shouldIgnore": False}
            self._answer({"files": [{"path": name, **regular} for name in asked]})
        elif path.endswith("/commit/main"):
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    hub.files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            address = f"http://{self.headers['Host']}/{hub.name}/commit/{COMMIT}"
            self._answer({"commitUrl": address, "commitOid": COMMIT, "success": True})
        else:
            self._missing()

    def do_GET(self) -> None:
        hub = type(self)
        hub.requests.append((self.command, self.path, self.headers.get("Authorization")))
        path = self.path.partition("?")[0]
        if hub.name is None or f"/{hub.name}" not in path:
            self._missing()
        elif path.startswith(f"/api/models/{hub.name}/tree/"):
            tree = [
                {"type": "file", "path": name, "size": len(content), "oid": oid(content)}
                for name, content in hub.files.items()
            ]
            self._answer(tree)
        elif path.startswith(f"/api/models/{hub.name}"):
            siblings = [{"rfilename": name} for name in hub.files]
            self._answer({"id": hub.name, "sha": COMMIT, "siblings": siblings})
        elif (found := re.fullmatch(rf"/{hub.name}/resolve/{COMMIT}/(.+)", path)) is not None:
            content = hub.files[found[1]]
            self._answer(content, ETag=f'"{oid(content)}"', X_Repo_Commit=COMMIT)
        else:
            self._missing()

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, *_: Any) -> None:
        pass


def oid(content: bytes) -> str:
    """The name that git gives to a file's content."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, type[Hub]]]:
    """Address of a hub on this machine, and what it holds."""
    monkeypatch.setenv("HF_TOKEN", "hf_of_a_test")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    handler = type("Handler", (Hub,), {"requests": [], "files": {}, "name": None})
    with serving(handler, monkeypatch) as address:
        yield address, handler


def test_a_run_comes_back_from_the_hub_as_it_was_pushed(hub, trained_run, tmp_path, capsys):
    address, held = hub
    url = push(trained_run, "somebody/excavator", endpoint=address)
    assert url == f"{address}/somebody/excavator"
    said = capsys.readouterr().out
    assert re.match(r"uploading   \d+ files, [\d.]+ MB, to somebody/excavator", said)
    assert {"README.md", "config.yaml", "metrics.json", "checkpoints/last.ckpt"} <= set(held.files)
    assert not [name for name in held.files if name.endswith((".log", ".lock"))]
    # What names the machine stays there.
    mine, theirs = status(trained_run), json.loads(held.files["run.json"])
    assert set(mine) - set(theirs) == {"directory", "process"}
    assert theirs["versions"] == mine["versions"]

    options = {"outputs": tmp_path / "outputs", "endpoint": address}
    run = fetch("hf://somebody/excavator", **options)
    assert run == tmp_path / "outputs" / "hub" / "somebody" / "excavator"
    for name, content in held.files.items():
        assert (run / name).read_bytes() == content
    mine, theirs = load_run(trained_run), load_run(run)
    assert theirs.step == mine.step
    for name, value in mine.module.state_dict().items():
        assert torch.equal(value, theirs.module.state_dict()[name]), name

    # What has not changed is not sent twice.
    held.requests.clear()
    assert fetch("hf://somebody/excavator", **options) == run
    assert not [
        path for command, path, _ in held.requests if command == "GET" and "resolve" in path
    ]

    # Without a network, the copy serves.
    assert fetch("hf://somebody/excavator", **{**options, "endpoint": NOWHERE}) == run
    assert capsys.readouterr().out.splitlines()[-1].startswith("offline     ")


def card_of(run: Path) -> tuple[dict[str, Any], str]:
    _, head, text = model_card(run, "somebody/excavator").split("---\n", 2)
    return yaml.safe_load(head), text


def test_the_model_card_has_scores_command_and_licence(trained_run, tmp_path):
    head, text = card_of(trained_run)
    scored = metrics(trained_run)
    assert head["library_name"] == "xplanes"
    assert "license" not in head
    (found,) = head["model-index"]
    scores = {m["type"]: m["value"] for m in found["results"][0]["metrics"]}
    assert scores["psnr"] == round(scored["test"]["psnr"], 4)
    assert f"| psnr | {scored['test']['psnr']:.4g} |" in text
    assert "xplanes train seed=0" in text
    assert "hf://somebody/excavator" in text
    assert "random initialisation" in text

    run = Path(shutil.copytree(trained_run, tmp_path / "run"))
    config = yaml.safe_load((run / "config.yaml").read_text())

    def card_with(**lrm: str) -> tuple[dict[str, Any], str]:
        (run / "config.yaml").write_text(yaml.safe_dump(config | {"lrm": lrm}))
        return card_of(run)

    head, text = card_with(name="base", repository="somebody/lrm", licence="CC-BY-NC-4.0")
    assert (head["license"], head["base_model"]) == ("cc-by-nc-4.0", "somebody/lrm")
    assert "licence CC-BY-NC-4.0" in text
    assert "bundled with X-Planes (MIT licence)" in card_with(name="tiny", bundled="tiny")[1]
    assert scored["lrm"] == {}

    # A sweep's own option cannot be repeated for one run.
    (run / "overrides.txt").write_text("sweep=table1\nmodel=six_planes\n")
    text = card_of(run)[1]
    assert "as a run of `sweep=table1`" in text
    assert "xplanes train" not in text
    assert "random initialisation" in card_with(name="auto", bundled="tiny")[1]


def test_commands_read_a_run_of_the_hub(hub, trained_run, tmp_path, monkeypatch, capsys):
    address, _ = hub
    monkeypatch.chdir(tmp_path)
    for name, verb in (("push", push), ("fetch", fetch)):
        at_hub = functools.partial(verb, endpoint=address)
        monkeypatch.setattr(f"xplanes.tools.hub.{name}", at_hub)
    assert main(["push", str(trained_run), "somebody/excavator"]) == 0
    assert f"wrote {address}/somebody/excavator" in capsys.readouterr().out
    arguments = ["--frames", "1", "--size", "16", "--time", "0", "--path", "fixed"]
    assert main(["render", "hf://somebody/excavator", *arguments, "--out", "a.png"]) == 0
    assert (tmp_path / "a.png").is_file()
    printed = capsys.readouterr().out
    for words in ("fetching    hf://somebody/excavator", "last.ckpt, step 40", "wrote a.png"):
        assert words in printed, words


def test_what_cannot_be_is_refused_in_words(hub, trained_run, tmp_path, monkeypatch):
    address, _ = hub
    options: dict[str, Any] = {"outputs": tmp_path}
    with pytest.raises(ConfigError, match="excavator: a repository on the hub is written USER/"):
        fetch("hf://excavator", **options)
    with pytest.raises(ConfigError, match=r"hf://no/body cannot be read.*hf auth login"):
        fetch("hf://no/body", **options, endpoint=address)
    with pytest.raises(ConfigError, match=r"hf://no/body cannot be read: .*:9 cannot be reached"):
        fetch("hf://no/body", **options, endpoint=NOWHERE)
    with pytest.raises(ConfigError, match="leave out @v1"):
        push(trained_run, "somebody/excavator@v1")
    (tmp_path / "run").mkdir()
    with pytest.raises(ConfigError, match=r"has no checkpoints/last\.ckpt"):
        push(tmp_path / "run", "somebody/excavator")
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(ConfigError, match=r"cannot be written.*HF_TOKEN"):
        push(trained_run, "somebody/excavator", endpoint=address)
