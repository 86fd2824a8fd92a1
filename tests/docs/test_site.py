"""The documentation: it builds without warnings and without the network, and its links lead somewhere."""

import ast
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(p for p in (ROOT / "docs").rglob("*.md") if "tutorials" not in p.parts)
TUTORIALS = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
RECIPES = sorted((ROOT / "docs" / "howto").glob("*.py"))
MADE = {"reference/case.md", "reference/commands.md", "reference/arrays.md", "tutorials/index"}
BUILD_LIMIT_S = 1200  # some two minutes of work; room for a machine that does other things too

# what a tutorial prints that the literature printed before
PUBLISHED = {"01_wiregrid": ["0.0708", "0.0017"], "02_sky": ["+0.127524", "+0.060660"]}


def _targets(page):
    """Targets of a page's Markdown links and pictures, without those in code."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", text))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT / "docs")))
def test_relative_links_lead_to_files(page):
    for target in _targets(page):
        path = target.split("#")[0]
        if not path or urlsplit(target).scheme:
            continue
        place = os.path.normpath(os.path.join(page.relative_to(ROOT / "docs").parent, path))
        if place in MADE or place.startswith("tutorials/"):
            continue
        file = ROOT / "docs" / place
        assert file.exists() or file.with_suffix(".md").exists(), target


def code_of(path):
    """Code of a script, or of all complete examples of a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
        return "\n".join(block for block in blocks if "import" in block)
    return text


@pytest.mark.parametrize("path", [*TUTORIALS, *RECIPES, *PAGES, ROOT / "README.md"], ids=lambda p: p.name)
def test_examples_call_only_what_is_public(path):
    """Packages and modules of the reference of the Python interface, and no name with an underscore."""
    tree = ast.parse(code_of(path))
    imported = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    reference = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    public = set(re.findall(r"^   (glintrack[.\w]*)$", reference, flags=re.MULTILINE))
    packages = {f"{n.module}.{a.name}" for n in imported for a in n.names} & public
    assert {n.module for n in imported if str(n.module).startswith("glintrack")} <= {
        *public, *(name.rpartition(".")[0] for name in packages)
    }  # fmt: skip
    names = [a.name for n in imported for a in n.names] + [n.module or "" for n in imported]
    names += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
    names += [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)]
    assert [n for n in names if any(part.startswith("_") for part in n.split("."))] == []


class _Page(HTMLParser):
    """What a page needs, where it links to, and the places in it."""

    def __init__(self, text):
        super().__init__()
        self.needs, self.links, self.ids = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.ids |= {given[key] for key in ("id", "name") if given.get(key)}
        if tag in ("script", "img", "source", "iframe") and given.get("src"):
            self.needs.append(given["src"])
        for key in ("srcset", "poster"):
            self.needs += [part.split()[0] for part in (given.get(key) or "").split(",") if part.strip()]
        if tag == "link" and given.get("rel") not in ("canonical", "author"):
            self.needs.append(given.get("href", ""))
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])


def _broken(site):
    """Files and places that a page of the site refers to and that are not in it."""
    pages = {path.resolve(): _Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    broken = []
    for path, page in pages.items():
        for target in [*page.needs, *page.links]:
            parts = urlsplit(target)
            if parts.scheme:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            file = file / "index.html" if file.is_dir() else file
            there = file.exists() and not (
                parts.fragment and file in pages and unquote(parts.fragment) not in pages[file].ids
            )
            if not there:
                broken.append(f"{path.name}: {target}")
    return broken


def _remote(site):
    """What the site would load from elsewhere; links that a reader may follow are none."""
    remote = []
    for path in site.rglob("*.html"):
        needs = _Page(path.read_text(encoding="utf-8")).needs
        remote += [f"{path.name}: {n}" for n in needs if urlsplit(n).netloc]
    for path in site.rglob("*.css"):
        loaded = re.findall(r"(?:url\(|@import)\s*['\"]?((?:https?:)?//[^'\")\s]+)", path.read_text("utf-8"))
        remote += [f"{path.name}: {n}" for n in loaded]
    return remote


@pytest.mark.slow
def test_the_site_builds_offline_and_runs_the_tutorials(tmp_path):
    pytest.importorskip("sphinx_gallery", reason="needs the extra `docs`")
    pytest.importorskip("myst_parser", reason="needs the extra `docs`")
    pytest.importorskip("furo", reason="needs the extra `docs`")
    leave = shutil.ignore_patterns("tutorials", "generated", "__pycache__")
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=leave)
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=leave)
    shutil.copy(ROOT / "CHANGELOG.md", tmp_path)
    # a proxy that nobody answers at: whatever asks the network fails, and a warning is an error
    nowhere = {
        name: "http://127.0.0.1:9" for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY")
    }
    site = tmp_path / "site"
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", tmp_path / "docs", site],
        env={**os.environ, **nowhere, "GLINTRACK_DOCS_FULL": "0"},
        capture_output=True,
        text=True,
        timeout=BUILD_LIMIT_S,
    )
    assert built.returncode == 0, built.stderr[-4000:]
    assert _remote(site) == []
    assert _broken(site) == []
    for tutorial in TUTORIALS:
        page = (site / "tutorials" / f"{tutorial.stem}.html").read_text(encoding="utf-8")
        assert f"sphx_glr_{tutorial.stem}_001" in page  # its first figure
        assert [row for row in PUBLISHED.get(tutorial.stem, []) if row not in page] == []
