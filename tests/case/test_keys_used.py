"""Every key of a case is described, and set by a packaged case or study, a page, or a test."""

import ast
import re
import tomllib
from collections import defaultdict
from pathlib import Path

from glintrack.case.design import Case
from glintrack.case.packaged import PACKAGED_CASES
from glintrack.core.designs import keys_of

ROOT = Path(__file__).parents[2]
MAX_KEYS = 210  # a new key needs a good reason, a description, and a test, case or page that sets it
KEYS = {key.name: key for _, keys in keys_of(Case) for key in keys}
# tables of a case whose keys stand by their last part in the tests of a folder, where it is not the same name
TABLES_OF_TESTS = {"sensor": {"sensor", "navigation"}, "core": {"sensor"}}
# tables of a study that hold keys of a case
STUDY_TABLES = re.compile(r"^(?:axes|base|cases|replicates|contrasts\.of|contrasts\.against)\.")


def dotted(values, stem=""):
    """Names of nested tables and lists of tables, with every part of their path."""
    for key, value in values.items():
        yield f"{stem}{key}"
        for table in [value] if isinstance(value, dict) else value if isinstance(value, list) else []:
            if isinstance(table, dict):
                yield from dotted(table, f"{stem}{key}.")


def keys_in_toml(text):
    """Keys that a text of TOML sets, whole or a fragment."""
    try:
        names = set(dotted(tomllib.loads(text)))
    except tomllib.TOMLDecodeError:
        names, table = set(), ""
        for line in text.splitlines():
            if heading := re.fullmatch(r"\s*\[+([\w.]+)\]+\s*", line):
                table = f"{heading[1]}."
            elif assigned := re.match(r"\s*([\w.]+)\s*=", line):
                names |= {assigned[1], f"{table}{assigned[1]}"}
    return names | {STUDY_TABLES.sub("", name) for name in names}


def keys_on_page(text):
    """Keys in the code blocks of a page: TOML, or options of a command."""
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)
    return {name for block in blocks for name in (*keys_in_toml(block), *re.findall(r"[\w.]+", block))}


def names_in_test(path):
    """Dotted names, keys of tables and keyword arguments of a test, and keys of TOML in its texts."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
            if "=" in node.value:
                yield from keys_in_toml(node.value)
        elif isinstance(node, ast.keyword) and node.arg:
            yield node.arg
            yield from of_tables(node.value, node.arg)
        elif isinstance(node, ast.Dict):
            yield from of_tables(node)


def of_tables(node, stem=""):
    """Dotted names of the keys of nested tables."""
    for key, value in zip(node.keys, node.values, strict=True) if isinstance(node, ast.Dict) else ():
        if isinstance(key, ast.Constant):
            name = f"{stem}.{key.value}" if stem else str(key.value)
            yield name
            yield from of_tables(value, name)


def keys_in_tests():
    """Keys that tests set: by a dotted name, or by their last part in the tests of their own stage."""
    by_ending = defaultdict(set)
    for key in KEYS:
        parts = key.split(".")
        for k in range(len(parts) - 1):
            by_ending[".".join(parts[k:])].add(key)
    found = set()
    for path in (ROOT / "tests").rglob("*.py"):
        tables = TABLES_OF_TESTS.get(folder := path.relative_to(ROOT / "tests").parts[0], {folder})
        by_last_part = defaultdict(set)
        for key in KEYS:
            if key.split(".")[0] in tables:
                by_last_part[key.rpartition(".")[2]].add(key)
        for name in names_in_test(path):
            found |= by_ending.get(name, set()) | by_last_part.get(name, set()) | ({name} & KEYS.keys())
    return found


def test_keys_are_few_and_described():
    assert len(KEYS) <= MAX_KEYS, f"{len(KEYS)} keys"
    assert not [name for name, key in KEYS.items() if not key.meaning]


def test_every_key_is_set_somewhere():
    known = set().union(*(keys_in_toml(path.read_text()) for path in PACKAGED_CASES.glob("*.toml")))
    known = known.union(*(keys_on_page(path.read_text()) for path in (ROOT / "docs").rglob("*.md")))
    assert KEYS.keys() - known - keys_in_tests() == set()
