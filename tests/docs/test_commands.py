"""What the documents say to type: options that exist, files that are there, code that compiles."""

import re
import shlex
from pathlib import Path

import pytest

from glintrack.cli.app import load_program

ROOT = Path(__file__).parents[2]
MADE = {"case.md", "commands.md", "arrays.md"}  # by the program itself
PAGES = [p for p in sorted((ROOT / "docs").rglob("*.md")) if p.name not in MADE] + [ROOT / "README.md"]
NAMES = [str(p.relative_to(ROOT)) for p in PAGES]
PROGRAM = load_program()
every_page = pytest.mark.parametrize("page", PAGES, ids=NAMES)


def _commands(text):
    """Command lines of a page, and commands in backticks; not those with alternatives or left out parts."""
    text = re.sub(r"\\\n\s*", " ", text)
    lines = re.findall(r"^\s*((?:\.venv/bin/)?glintrack [^\n]+)", text, flags=re.MULTILINE)
    lines += re.findall(r"`(glintrack [^`\n]+)`", text)
    return [re.sub(r"\$?\bk\b", "0", line) for line in lines if "|" not in line and "…" not in line]


def _parse(group, words):
    """Walk to the command and let it read its arguments, without running it."""
    while getattr(group, "commands", None) and words and words[0] in group.commands:
        group, words = group.commands[words[0]], words[1:]
    if words == ["--help"] or (getattr(group, "commands", None) and not words):
        return
    for parameter in group.params:
        if parameter.name in ("case", "study", "changes", "output"):
            parameter.callback = None  # it looks for the file, which the reader of a page is to write
    group.make_context(group.name, words)


@every_page
def test_commands_are_the_programs(page):
    for line in _commands(page.read_text(encoding="utf-8")):
        words = shlex.split(re.split(r"\s+&&?(?:\s|$)", line)[0], comments=True)[1:]
        if not words or not re.fullmatch(r"[a-z]+", words[0]) or words[0] not in PROGRAM.commands:
            continue  # a sentence that begins with the program's name
        if words[0] == "study" and words[1] not in ("run", "report"):
            words.insert(1, "run")
        try:
            _parse(PROGRAM, words)
        except Exception as error:
            if type(error).__name__ != "MissingParameter":  # a command that is named, not typed
                pytest.fail(f"{line}: {error}")


@every_page
def test_files_that_are_named_exist(page):
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"\b(?:tests|benchmarks|validation|tools|examples|cases)/[\w/]+\.(?:py|toml)", text)
    assert [path for path in named if not (ROOT / path).exists()] == []


@every_page
def test_python_in_the_documents_compiles(page):
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL):
        compile(block, page.name, "exec")
