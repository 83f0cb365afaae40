"""Pages that are generated are up to date, and the README's commands are real."""

import re
import runpy
import shlex
from pathlib import Path

from tests.training.runs import changed, composing_once
from xplanes.cli import build_parser
from xplanes.launch import check_keys

ROOT = Path(__file__).resolve().parent.parent


def test_configuration_page_is_what_the_generator_writes() -> None:
    generator = runpy.run_path(str(ROOT / "docs" / "generate.py"))
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert page == generator["document"](), "run: python docs/generate.py"


def test_links_between_pages_lead_somewhere() -> None:
    folders = [ROOT / "docs", ROOT / "benchmarks" / "results"]
    pages = [page for folder in folders for page in folder.rglob("*.md")]
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *pages]:
        for link in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / link).exists(), f"{page.name}: {link}"


CALL = re.compile(
    r"^    (?:(?P<train>python train\.py)|(?:python -m )?xplanes)(?: (?P<rest>.*))?$", re.MULTILINE
)
"""A line of a page that calls the program, by any of its names."""


def commands() -> list[list[str]]:
    """Arguments of the program in every such line."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [
        [*(["train"] if call["train"] else []), *shlex.split(call["rest"] or "", comments=True)]
        for page in pages
        for call in CALL.finditer(page.read_text(encoding="utf-8"))
    ]


def test_training_commands_of_the_pages_compose() -> None:
    training = [words[1:] for words in commands() if words[:1] == ["train"]]
    assert len(training) > 20
    with composing_once():
        for arguments in training:
            check_keys(arguments)
            settings = [a for a in arguments if "=" in a and not a.startswith("hydra")]
            # Of what a sweep goes through, the first; a list is one value.
            chosen = [a if "[" in a else a.split(",")[0] for a in settings]
            assert changed((), *chosen)["model"]["name"], arguments


def test_other_commands_of_the_pages_parse() -> None:
    others = [words for words in commands() if words[:1] != ["train"]]
    assert len(others) > 20
    for arguments in others:
        assert build_parser().parse_args(arguments), arguments
