"""Pages that are generated are up to date, and the README's commands are real."""

import re
import runpy
import shlex
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from xplanes.cli import build_parser
from xplanes.config import register_schemas
from xplanes.launch import CONF, check_keys

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


def commands(program: str) -> list[list[str]]:
    """Arguments of every line of the pages that calls ``program``."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [
        shlex.split(line, comments=True)[len(program.split()) :]
        for page in pages
        for line in page.read_text(encoding="utf-8").splitlines()
        if line.startswith(f"    {program} ")
    ]


@pytest.mark.parametrize("arguments", commands("python train.py"), ids=" ".join)
def test_training_commands_of_the_pages_compose(arguments: list[str]) -> None:
    check_keys(arguments)
    settings = [a for a in arguments if "=" in a and not a.startswith("hydra")]
    # Of what a sweep goes through, the first; a list is one value.
    chosen = [a if "[" in a else a.split(",")[0] for a in settings]
    register_schemas()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        assert compose("train", chosen).model.name


@pytest.mark.parametrize("arguments", commands("python -m xplanes"), ids=" ".join)
def test_other_commands_of_the_pages_parse(arguments: list[str]) -> None:
    assert build_parser().parse_args(arguments)
