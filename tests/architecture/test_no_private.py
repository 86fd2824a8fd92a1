"""No private name of a dependency is imported, read, patched or subclassed."""

import ast
from pathlib import Path

import pytest

import glintrack

PACKAGE = Path(glintrack.__file__).parent
LIBRARIES = {"numba", "llvmlite", "xarray", "pydantic", "pydantic_core", "typer", "click", "rich", "rasterio"}


def is_private(name):
    return name.startswith("_") and not (name.startswith("__") and name.endswith("__"))


def private_uses(source):
    """Lines at which a private module or name of a library is used."""
    tree = ast.parse(source)
    found, known = [], set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in LIBRARIES:
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            known |= {alias.asname or alias.name for alias in node.names}
            found += [node.lineno] * any(map(is_private, names))
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] in LIBRARIES:
                    known.add(alias.asname or alias.name.split(".")[0])
                    found += [node.lineno] * any(map(is_private, alias.name.split(".")))
    subclasses = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and any(root_of(base) in known for base in node.bases)
    ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr) and root_of(node) in known:
            found.append(node.lineno)
        if isinstance(node, ast.Assign):  # a patch of what a library holds
            found += [t.lineno for t in node.targets if isinstance(t, ast.Attribute) and root_of(t) in known]
    for node in subclasses:  # of a library's class: only what the class itself sets is its own
        own = {
            n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)
        }
        own |= {n.name for n in node.body if isinstance(n, ast.FunctionDef)}
        own |= {
            n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)
        }
        own |= {
            t.id for n in node.body if isinstance(n, ast.Assign) for t in n.targets if isinstance(t, ast.Name)
        }
        found += [
            n.lineno
            for n in ast.walk(node)
            if isinstance(n, ast.Attribute)
            and root_of(n) == "self"
            and is_private(n.attr)
            and n.attr not in own
        ]
    return sorted(set(found))


def root_of(node):
    """Name that a chain of attributes and calls begins with."""
    while isinstance(node, ast.Attribute | ast.Call | ast.Subscript):
        node = node.func if isinstance(node, ast.Call) else node.value
    return node.id if isinstance(node, ast.Name) else ""


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_private_name_of_a_dependency(path):
    assert private_uses(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        "from rasterio._err import CPLE_BaseError",
        "import numba\nnumba.core._dispatcher",
        "from numba.core.caching import FunctionCache\nFunctionCache.load_overload = print",
        "import numba as nb\nnb.njit(f)._cache",
        "from rich import Progress\nclass Bar(Progress):\n    def f(self):\n        return self._tasks",
        "import pydantic._internal._model_construction",
    ],
)
def test_the_check_can_fail(source):
    assert private_uses(source)


def test_own_private_names_pass():
    source = (
        "from rich.progress import Progress\nclass Bar(Progress):\n    def f(self):\n        self._told = 1\n"
    )
    assert private_uses(source) == []


def test_no_allocator_and_no_finalizer_tricks():
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not any(word in text for word in ("mallopt", "malloc_trim", "__del__", "sys.meta_path")), path
