"""The code and commands in the README and the documentation run, and the reference is complete."""

from __future__ import annotations

import argparse
import doctest
import importlib
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import sb3_knntd.callbacks
import yaml
from markdown_it import MarkdownIt
from markdown_it.token import Token

import sb3_knntd
import sb3_knntd.envs
from sb3_knntd.cli import main

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = [page for page in PAGES if "_build" not in page.parts]


def blocks(page: Path, language: str) -> list[Token]:
    """All code blocks of one language on a page."""
    tokens = MarkdownIt().enable("table").parse(page.read_text(encoding="utf-8"))
    return [token for token in tokens if token.type == "fence" and token.info.strip() == language]


def commands(page: Path) -> Iterator[list[str]]:
    """The commands of a page, split into words."""
    for block in blocks(page, "bash"):
        waiting = ""
        for line in block.content.replace("\\\n", " ").splitlines():
            waiting += f"{line}\n"
            try:
                words = shlex.split(waiting, comments=True)
            except ValueError:  # a quotation continues on the next line
                continue
            waiting = ""
            if words:
                yield words
        assert not waiting, f"a quotation is not closed in {page.name}: {waiting}"


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


RUNNING = [page for page in PAGES if blocks(page, "python")]
COMMANDS = [(page, words) for page in PAGES for words in commands(page)]


def test_pages_are_found() -> None:
    assert {"README.md", "docs/getting_started.md", "docs/guide.md"} <= set(map(name_of, RUNNING))
    assert any(words[0] == "sb3-knntd" for _, words in COMMANDS)


@pytest.mark.parametrize("page", RUNNING, ids=name_of)
def test_python_blocks_run(page: Path, tmp_path: Path) -> None:
    # Run the blocks as one program; a traceback has the line numbers of the page.
    program = ""
    for block in blocks(page, "python"):
        assert block.map is not None
        program += "\n" * (block.map[0] + 1 - program.count("\n")) + block.content
    run = subprocess.run([sys.executable, "-"], input=program, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


class ArgumentsReadError(BaseException):
    """Raised when a command has parsed its arguments."""


def parse(command: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a command until its arguments are parsed."""
    original = argparse.ArgumentParser.parse_args

    def parse_args(self: Any, args: Any = None, namespace: Any = None) -> Any:
        parsed = original(self, args, namespace)
        if "arguments" in parsed:  # commands of RL Zoo, which parses them itself
            return parsed
        raise ArgumentsReadError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
    with pytest.raises(ArgumentsReadError):
        command()


@pytest.mark.parametrize(
    ("page", "words"), COMMANDS, ids=[f"{name_of(page)}: {shlex.join(words)}" for page, words in COMMANDS]
)
def test_commands_exist_and_take_their_arguments(page: Path, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    program, *arguments = words
    if program == "sb3-knntd":
        parse(lambda: main(arguments), monkeypatch)
    elif program == "make":
        targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(arguments) <= set(targets)
    elif program == "pip":
        for package, extras in re.findall(r"([\w.-]+)\[([\w,-]+)\]", " ".join(arguments)):
            ours = package in (".", "sb3-knntd")
            there = PROJECT["optional-dependencies"] if ours else metadata(package).get_all("Provides-Extra")
            assert set(extras.split(",")) <= set(there)
    elif Path(program).name == "python" and arguments[0] == "-m":
        module = arguments[1]
        assert find_spec(module) is not None
        if module.split(".")[0] in ("sb3_knntd", "benchmarks") and len(arguments) > 2:
            monkeypatch.setattr(sys, "argv", arguments[1:])
            parse(lambda: runpy.run_module(module, run_name="__main__"), monkeypatch)
    elif Path(program).name == "python" and arguments[0] != "-c":
        assert (ROOT / arguments[0]).is_file()


def linked_files() -> list[tuple[Path, str]]:
    """Links to files on pages that Sphinx does not check."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    return [(page, link) for page in pages for link in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))]


@pytest.mark.parametrize(("page", "link"), linked_files(), ids=lambda value: getattr(value, "name", value))
def test_links_exist(page: Path, link: str) -> None:
    assert (page.parent / link).exists()


@pytest.mark.parametrize("environment", sb3_knntd.envs.__all__)
def test_docstrings_of_environments_run_and_have_a_page(environment: str) -> None:
    kind = getattr(sb3_knntd.envs, environment)
    example = doctest.DocTestParser().get_doctest(kind.__doc__, {}, environment, None, None)
    assert example.examples
    assert doctest.DocTestRunner().run(example).failed == 0
    pages = (ROOT / "docs" / "reference" / "environments").glob("*.md")
    assert any(f"{{docstring}} sb3_knntd.envs.{environment}\n" in page.read_text() for page in pages)


@pytest.mark.parametrize("module", ["sb3_knntd", "sb3_knntd.callbacks"])
def test_reference_has_every_public_name(module: str) -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference").glob("*.md"))
    described = set(re.findall(r"\.\. auto(?:class|function):: (?:[\w.]+\.)?(\w+)$", text, re.MULTILINE))
    assert set(importlib.import_module(module).__all__) <= described


def test_reference_has_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    names = re.findall(r"^    (\w+) ", capsys.readouterr().out, re.MULTILINE)
    assert "demo" in names
    text = (ROOT / "docs" / "reference" / "command_line.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in names)


@pytest.mark.slow
def test_pictures_of_the_algorithms_are_drawn(tmp_path: Path) -> None:
    script = ROOT / "docs" / "pictures.py"
    subprocess.run([sys.executable, str(script), str(tmp_path)], check=True)
    pages = (ROOT / "docs" / name for name in ("algorithm.md", "knndyna.md"))
    shown = re.findall(r"\(images/(\w+\.png)\)", "".join(page.read_text(encoding="utf-8") for page in pages))
    assert {path.name for path in tmp_path.iterdir()} == set(shown)


def test_citation_matches_this_version_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    # Required fields of the format.
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["title"] == PROJECT["name"]
    assert citation["version"] == PROJECT["version"]
    paper = citation["references"][0]
    bibtex = (ROOT / "README.md").read_text(encoding="utf-8").split("```bibtex")[1]
    fields = dict(re.findall(r"(\w+)\s*=\s*\{(.*)\}", bibtex))
    assert fields["doi"] == paper["doi"]
    assert fields["title"] == paper["title"]
    assert fields["year"] == str(paper["year"])
    assert fields["pages"] == f"{paper['start']}--{paper['end']}"
