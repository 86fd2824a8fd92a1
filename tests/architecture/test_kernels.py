"""Compiled kernels give the same numbers at a first start, which compiles them, as later, from the cache.

A function that kernels and Python call (``nb.njit``) is compiled by itself and again, optimised twice, within
each kernel. At a first start all of these lie in memory under one name and the first is called; later only
the kernel's own is there. Strict arithmetic is the same in both. With fast math the compiler may add in
another order, so such a function must be inlined into the kernels that call it.
"""

import ast
from pathlib import Path

import glintrack

PACKAGE = Path(glintrack.__file__).parent
MARKS = ("nb.njit", "numba.njit", "njit")


def options(function):
    """Keywords of a function's ``nb.njit`` mark; None if it has none."""
    for mark in function.decorator_list:
        if isinstance(mark, ast.Call) and ast.unparse(mark.func) in MARKS:
            return {word.arg: ast.unparse(word.value) for word in mark.keywords}
    return None


def kernels(sources):
    """(module, name) of every compiled function: its options, and the compiled functions it names."""
    found, known = {}, {}
    for module, source in sources.items():
        tree = ast.parse(source)
        names = known[module] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                names.update({a.asname or a.name: (node.module, a.name) for a in node.names})
        for node in tree.body:
            if isinstance(node, ast.FunctionDef):
                names[node.name] = (module, node.name)
                if options(node) is not None:
                    found[module, node.name] = node
    return {
        (module, name): (
            options(node),
            {known[module].get(n.id) for n in ast.walk(node) if isinstance(n, ast.Name)}
            & (found.keys() - {(module, name)}),
        )
        for (module, name), node in found.items()
    }


def not_inlined(sources):
    """Functions with fast math, their own or inlined, that a kernel calls without inlining them."""
    every = kernels(sources)
    fast = {one for one, (words, _) in every.items() if words.get("fastmath", "False") != "False"}
    while more := {one for one, (_, calls) in every.items() if calls & fast} - fast:
        fast |= more
    called = set().union(*(calls for _, calls in every.values()))
    return sorted(one for one in fast & called if every[one][0].get("forceinline") != "True")


def test_fast_math_is_inlined_into_the_kernels_that_call_it():
    sources = {
        ".".join(["glintrack", *path.relative_to(PACKAGE).with_suffix("").parts]): path.read_text(
            encoding="utf-8"
        )
        for path in PACKAGE.rglob("*.py")
    }
    assert len(kernels(sources)) > 150
    assert not not_inlined(sources)


def test_the_check_finds_calls_through_other_functions():
    low = "import numba as nb\n@nb.njit(fastmath=True)\ndef add(x):\n    return x\n"
    high = (
        "import numba as nb\nfrom low import add\n@nb.njit(cache=True)\ndef rows(x):\n    return add(x)\n"
        "@nb.njit(cache=True)\ndef entry(x):\n    return rows(x)\n"
    )
    assert not_inlined({"low": low, "high": high}) == [("high", "rows"), ("low", "add")]
    inlined = low.replace("fastmath=True", "fastmath=True, forceinline=True")
    assert not_inlined({"low": inlined, "high": high}) == [("high", "rows")]
