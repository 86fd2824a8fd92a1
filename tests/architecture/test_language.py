"""A smoke alarm for the language: names, first lines of docstrings, and sentences of the user guide.

Counts by word lists and endings are heuristics. The judge is a reader.
"""

import ast
import re

import pytest

from tests.architecture.test_style import MODULES, NAMES, ROOT, functions, tree_of

MAX_PARTICIPLE_SHARE = 0.05  # of the public functions; pvlib has 0.05
MAX_SENTENCE_WORDS = 18  # mean of a page of the user guide
README_LINES, README_WORDS, DOCUMENTATION_WORDS, CHANGELOG_LINES = 110, 900, 30_000, 40
# without "read", "put" and "left", which are mostly a verb or a side
IRREGULAR = set(
    "told kept born lit seen met held found known made drawn flown grown taken given shown sent led turned"
    " learnt begun worn written built chosen hidden bent lent sworn laid brought thought"
    " caught worked gone".split()
)
ADJECTIVES = set(
    "surest nearest best finer coarse bare level usual likely sure ready fresh apart alike beside among near"
    " even whole some own other still again anew".split()
)
NOT_PARTICIPLES = {"seed", "speed", "need", "feed", "embed"}
QUESTION = re.compile(r"(What|Which|Whose|Whether|How|Where|Who|Of)\b")
OLD_LIMITS = re.compile(r"\b_?(?:MOST|LEAST)_\w+")
FORBIDDEN = re.compile(
    r"\b(is told|are told|in the place of|what came out|anew|likeliest|surest|to the last (?:bit|digit)"
    r"|no command repeats|wanted \d|was missed|thrice)\b",
    re.IGNORECASE,
)
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GUIDE = sorted((ROOT / "docs" / "guide").glob("*.md"))


def is_participle(name):
    """Return True if a function's name begins or ends with a participle or an adjective."""
    words = [word for word in name.split("_") if word]
    first, last = words[0], words[-1]
    ends_in_ed = first.endswith("ed") and len(first) > 4 and first not in NOT_PARTICIPLES
    return first in IRREGULAR | ADJECTIVES or last in IRREGULAR or ends_in_ed


def prose(page):
    """Text of a page without code blocks, tables, headings, pictures and comments."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return "\n".join(line for line in text.splitlines() if not line.startswith(("|", "#", "![", "<!--")))


def words(text):
    return re.findall(r"[A-Za-z'\u2019]+", text)


def sentence_lengths(page):
    """Words of each sentence or item of a list with more than three."""
    items = re.sub(r"\n\s*(?:[-*]|\d+\.)\s+|\n\n", ". ", prose(page))
    sentences = re.split(r"(?<=[.!?])\s+", items.replace("\n", " "))
    return [count for count in map(len, map(words, sentences)) if count > 3]


def test_functions_are_named_by_verbs_or_by_what_they_return():
    public = [f.name for path in MODULES for f in functions(tree_of(path)) if not f.name.startswith("_")]
    participles = [name for name in public if is_participle(name)]
    assert len(participles) <= MAX_PARTICIPLE_SHARE * len(public), sorted(set(participles))


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_docstrings_state_and_limits_are_called_min_and_max(path):
    tree = tree_of(path)
    nodes = [n for n in ast.walk(tree) if isinstance(n, (ast.Module, ast.ClassDef, ast.FunctionDef))]
    questions = [text for n in nodes if QUESTION.match(text := ast.get_docstring(n) or "")]
    assert not questions
    assert not OLD_LIMITS.findall(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_pages_avoid_the_old_dialect(page):
    assert not FORBIDDEN.findall(prose(page))


@pytest.mark.parametrize("page", GUIDE, ids=[page.name for page in GUIDE])
def test_sentences_of_the_user_guide_are_short(page):
    lengths = sentence_lengths(page)
    assert sum(lengths) <= MAX_SENTENCE_WORDS * len(lengths)


def test_documentation_is_short():
    readme = ROOT / "README.md"
    assert len(readme.read_text(encoding="utf-8").splitlines()) <= README_LINES
    assert len(words(prose(readme))) <= README_WORDS
    assert sum(len(words(prose(page))) for page in PAGES[1:]) <= DOCUMENTATION_WORDS
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= CHANGELOG_LINES
