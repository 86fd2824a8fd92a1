"""What is done in one place stays there: turning Stokes vectors, hashes, CSV, TOML and the sRGB curve."""

import ast
from pathlib import Path

import pytest

import glintrack

PACKAGE = Path(glintrack.__file__).parent
SOURCES = {str(p.relative_to(PACKAGE)): p.read_text(encoding="utf-8") for p in sorted(PACKAGE.rglob("*.py"))}
Q, U = {"q", "s1"}, {"u", "s2"}


def factors(node):
    """Names that are multiplied in a product, also under a minus."""
    if isinstance(node, ast.UnaryOp):
        return factors(node.operand)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        return factors(node.left) | factors(node.right)
    return {node.id} if isinstance(node, ast.Name) else set()


def turns(source):
    """Lines where Q times something and U times something are added, as a rotation does."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            left, right = factors(node.left), factors(node.right)
            squares = len(left) < 2 or len(right) < 2  # q * q + u * u is the degree's
            if not squares and ((left & Q and right & U) or (left & U and right & Q)):
                found.append(node.lineno)
    return found


def double_angles(source):
    """Lines with the cosine or sine of twice an angle that is no full turn."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not (isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("cos", "sin")):
            continue
        said = ast.unparse(node.args[0])
        if said.startswith(("2 *", "2.0 *")) and "pi" not in said:
            found.append(node.lineno)
    return found


def importing(module):
    """Files that import a module."""
    found = set()
    for name, source in SOURCES.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import) and module in {alias.name for alias in node.names}:
                found.add(name)
            if isinstance(node, ast.ImportFrom) and node.module == module:
                found.add(name)
    return found


def test_nothing_else_turns_stokes_vectors():
    assert {n for n, source in SOURCES.items() if turns(source)} == {"stokes.py"}
    assert {name for name, source in SOURCES.items() if double_angles(source)} <= {"stokes.py"}


@pytest.mark.parametrize(
    ("module", "only"),
    [
        ("hashlib", {"io/atomic.py", "core/numba_cache.py"}),
        ("csv", {"io/tables.py"}),
        ("tomli_w", {"io/toml.py"}),
    ],
)
def test_one_file_each(module, only):
    assert importing(module) == only


def test_one_display_curve_and_one_reader_of_csv():
    assert {name for name, source in SOURCES.items() if "0.0031308" in source or "12.92" in source} == {
        "core/colour.py"
    }
    assert {name for name, source in SOURCES.items() if "pd.read_csv" in source} == {"io/tables.py"}


def test_the_checks_can_fail():
    assert turns("a = cos2 * q + sin2 * u") and turns("a = c * u - s * q") and not turns("a = q * q + u * u")
    assert double_angles("np.cos(2 * angle)") and not double_angles("np.cos(2 * np.pi * v)")
