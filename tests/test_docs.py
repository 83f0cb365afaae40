"""Pages that are generated are up to date, and the pages' commands and keys are real."""

import ast
import inspect
import pkgutil
import re
import runpy
import shlex
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.training.runs import changed, small_config
from tests.warm import ROOT, python
from xplanes import __version__
from xplanes.cli import build_parser, further_commands
from xplanes.config import compose_plain, near_names
from xplanes.experiment import Experiment
from xplanes.files import read_json
from xplanes.run import run
from xplanes.tools.published import OWN, PUBLISHED
from xplanes.tools.sweep import SCORES
from xplanes.tools.table import write_tables

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}


@pytest.fixture(scope="module")
def generator() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs" / "generate.py"))


def test_generated_pages_are_what_the_generator_writes(generator):
    pages = generator["PAGES"]
    notebook = "../examples/first_minute.ipynb"
    assert set(pages) == {"configuration.md", "command_line.md", "api.md", notebook}
    for name, write in pages.items():
        page = (ROOT / "docs" / name).read_text(encoding="utf-8")
        assert page == write(), "run: python docs/generate.py"


def test_addresses_and_version_are_the_same_wherever_they_stand(generator):
    addressed = generator["addressed"]
    for name in generator["ADDRESSED"]:
        text = (ROOT / name).read_text(encoding="utf-8")
        assert text == addressed(name), "run: python docs/generate.py"
    assert f"version = {{{__version__}}}" in TEXTS[ROOT / "README.md"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == __version__


@pytest.mark.slow
@pytest.mark.skipif(not find_spec("mkdocs"), reason="the site needs the extra docs")
def test_the_site_builds_without_a_warning(tmp_path):
    build = ("-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path))
    python(*build, env={"NO_MKDOCS_2_WARNING": "1"})
    api = (tmp_path / "api" / "index.html").read_text(encoding="utf-8")
    for name in (
        "training.module.RadianceModule",
        "scenes.datamodule.SceneDataModule",
        "decomposition.rpca.robust_pca",
        "lrm.model.LRM.encode",
    ):
        assert f'id="xplanes.{name}"' in api, name


def test_the_configuration_page_says_what_every_setting_means():
    text = TEXTS[ROOT / "docs" / "configuration.md"]
    rows = re.findall(r"^\| `([\w.]+)` \| (.*?) \| (.*) \|$", text, re.MULTILINE)
    assert len(rows) > 250
    for key, meaning, value in rows:
        assert meaning.strip() or key.startswith("logger."), key
        assert value, key


def test_links_between_pages_lead_somewhere():
    for page, text in TEXTS.items():
        for link in re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", text):
            assert (page.parent / link).exists(), f"{page.name}: {link}"


def test_the_api_page_has_the_signatures_of_all_that_it_lists():
    text = TEXTS[ROOT / "docs" / "api.md"]
    found = re.findall(r"```python\n((?:(?!```).)+)```\n\n::: ([\w.]+)", text, re.DOTALL)
    assert len(found) == len(re.findall(r"^::: ", text, re.MULTILINE)) > 20
    for code, path in found:
        line, definition = ast.parse(code).body
        assert isinstance(line, ast.ImportFrom), path
        assert isinstance(definition, ast.ClassDef | ast.FunctionDef), path
        named = pkgutil.resolve_name(path)
        assert pkgutil.resolve_name(f"{line.module}:{definition.name}") is named, path
        members = [each for each in ast.walk(definition) if isinstance(each, ast.FunctionDef)]
        for each in members:
            thing = named if each is definition else inspect.getattr_static(named, each.name)
            thing = getattr(thing, "fget", None) or getattr(thing, "func", thing)
            expected = list(inspect.signature(inspect.unwrap(thing)).parameters)
            written = [*each.args.posonlyargs, *each.args.args, each.args.vararg]
            written += [*each.args.kwonlyargs, each.args.kwarg]
            assert [word.arg for word in written if word] == expected, f"{path}: {each.name}"


CALL = re.compile(
    r"^    (?:[A-Z_]+=\S+ )*"
    r"(?:(?P<train>python train\.py)|(?:python -m )?xplanes)(?: (?P<rest>.*))?$",
    re.MULTILINE,
)
"""A line of a page that calls the program, by any of its names."""


def commands() -> list[list[str]]:
    """Arguments of the program in every such line."""
    return [
        [*(["train"] if call["train"] else []), *shlex.split(call["rest"] or "", comments=True)]
        for page, text in TEXTS.items()
        if page.name != "CONTRIBUTING.md"  # Its commands name components that the reader adds.
        for call in CALL.finditer(text)
    ]


def test_training_commands_of_the_pages_compose():
    training = [words[1:] for words in commands() if words[:1] == ["train"]]
    assert len(training) > 12
    for chosen in {first_of(arguments) for arguments in training}:
        plain_keys = not any(re.match(r"[+~]|plugins=", text) for text in chosen)
        plain = changed((), *chosen) if plain_keys else compose_plain("train", chosen)
        if not plain["plugins"]:  # They name modules of the reader's own.
            assert Experiment.read(plain).method.model.name, chosen


def first_of(arguments: list[str]) -> tuple[str, ...]:
    """The settings of a command; of what a sweep goes through, the first."""
    settings = [a for a in arguments if "=" in a and not a.startswith("hydra")]
    return tuple(a if "[" in a else a.split(",")[0] for a in settings)


def test_other_commands_of_the_pages_parse():
    others = [words for words in commands() if words[:1] != ["train"]]
    assert len(others) > 12
    for arguments in others:
        assert build_parser(further_commands()).parse_args(arguments), arguments


def test_shells_leave_the_commands_of_the_pages_alone():
    # zsh, the shell of every Mac, takes brackets, braces, * and ? outside of quotes for file names.
    for page, text in TEXTS.items():
        for line in text.splitlines():
            if not re.match(r"    (\w+=\S+ )*(python|xplanes) ", line):
                continue
            words = line.partition("   #")[0]
            bare = re.sub(r"\"[^\"]*\"|'[^']*'|\$\{?\w+\}?", "", words)
            assert not re.search(r"[\[\]{}*?()]", bare), f"{page.name}: {line}"


KEY = re.compile(
    r"`\+?((?:data|model|lrm|preparation|decomposition|trainer|callbacks|logger)"
    r"(?:\.\w+)+)(?:=[^`]*)?`"
)
"""A key of a configuration in the text of a page."""

FILES = {".ckpt", ".pth", ".safetensors", ".py", ".yaml", ".pt"}


def test_keys_in_the_text_of_the_pages_exist():
    text = TEXTS[ROOT / "docs" / "configuration.md"]
    known = set(re.findall(r"^\| `([\w.]+)` \|", text, re.MULTILINE))
    known |= {key.rpartition(".")[0] for key in known}
    named = [
        (page.name, key)
        for page, text in TEXTS.items()
        if page.name != "glossary.md"  # It lists the keys of metrics.json.
        for key in KEY.findall(text)
        if Path(key).suffix not in FILES
    ]
    assert len(named) > 12
    for page, key in named:
        if key.rpartition(".")[2].isupper() or "NAME" in key:
            continue
        assert key in known, f"{page}: {key} {near_names([f'{key}=0'])}"


CODE = re.compile(r"`(xplanes(?:\.\w+)+)`")
"""A module, class or function in the text of a page."""


def test_code_named_in_the_text_of_the_pages_exists():
    named = sorted(set(CODE.findall("\n".join(TEXTS.values()))))
    assert len(named) > 12
    for name in named:
        assert pkgutil.resolve_name(name), name


def keys_of(node: Any) -> Iterator[str]:
    """Names of everything in a JSON file, at every depth."""
    for key, value in node.items() if isinstance(node, dict) else ():
        yield key
        yield from keys_of(value[0] if isinstance(value, list) and value else value)


@pytest.mark.slow
def test_the_glossary_has_every_column_and_key_that_a_run_writes(scenes, tmp_path):
    changes = ("lrm=tiny", "preparation.frames=3", f"preparation.cache={tmp_path / 'cache'}")
    config = small_config(scenes, *changes, "trainer.max_steps=2", "media=true")
    run(config, tmp_path / "runs" / "run", [], resume=False)
    written = tmp_path / "runs" / "run"
    metrics, record = (read_json(written / f"{name}.json") for name in ("metrics", "run"))
    assert metrics["decomposition"]["xy"]
    assert metrics["lrm"]["frames"] == 3
    record = {key: None if key in ("versions", "files") else record[key] for key in record}
    write_tables(tmp_path / "runs")
    tables = (tmp_path / "runs" / "table.md").read_text(encoding="utf-8").splitlines()
    headers = [row for row, rule in pairwise(tables) if rule.startswith("| --")]
    columns = [cell.strip() for row in headers for cell in row.strip("|").split("|")]
    assert "s to 20 dB" in columns
    assert "drift" in columns
    keyed = (tmp_path / "runs" / "table.csv").read_text(encoding="utf-8").splitlines()[0]
    rows = (written / "curve.csv").read_text(encoding="utf-8").splitlines()[0]
    page = TEXTS[ROOT / "docs" / "glossary.md"]
    known = {text.rpartition(".")[2] for text in re.findall(r"`([^`]+)`", page)}
    names = [*keys_of(metrics), *keys_of(record), *columns, *keyed.split(","), *rows.split(",")]
    names += [*OWN, *PUBLISHED, *(score.heading for score in SCORES.values()), *SCORES]
    assert not set(names) - known
