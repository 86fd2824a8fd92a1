"""Values with names: few parameters, records in place of long tuples, one meaning for each class name.

Compiled functions are exempt, because numba takes no records; so are commands, whose parameters are options.
"""

import ast
from collections import defaultdict

import pytest

from tests.architecture.test_layers import package_sources

MAX_PARAMETERS = 10
MAX_POSITIONAL = 6  # values of a constructor
MAX_TUPLE = 3  # values of a tuple between functions
LIBRARIES = ("np", "math", "xr", "pd", "shapely", "scipy", "rasterio")
COMPILED = ("njit", "vectorize")
# "module.name" of a function or a class that is made, or a class's name: still to be mended; empty it
OPEN: set[str] = set()


def is_compiled(function):
    """Whether a decorator compiles the function."""
    return any(word in ast.unparse(mark) for mark in function.decorator_list for word in COMPILED)


def parameters(function):
    """Names of a function's parameters, without ``self`` and ``cls``."""
    given = function.args
    names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return [name for name in names if name not in ("self", "cls")]


def functions_of(tree):
    """(function, whether it is compiled or lies in one that is) of a module."""
    found = []

    def walk(node, compiled):
        for child in ast.iter_child_nodes(node):
            inside = compiled
            if isinstance(child, ast.FunctionDef):
                inside = compiled or is_compiled(child)
                found.append((child, inside))
            walk(child, inside)

    walk(tree, False)
    return found


def own_nodes(function):
    """Nodes of a function's body, without those of functions within it."""
    waiting, found = list(function.body), []
    while waiting:
        node = waiting.pop()
        found.append(node)
        waiting += [one for one in ast.iter_child_nodes(node) if not isinstance(one, ast.FunctionDef)]
    return found


def module_nodes(tree):
    """Nodes of a module outside its functions."""
    waiting, found = [tree], []
    while waiting:
        node = waiting.pop()
        found.append(node)
        waiting += [one for one in ast.iter_child_nodes(node) if not isinstance(one, ast.FunctionDef)]
    return found


def is_long(node):
    """Whether a node is a tuple of more values than may go without names; lists of constants are not."""
    if not isinstance(node, ast.Tuple) or len(node.elts) <= MAX_TUPLE:
        return False
    listed = all(isinstance(one, ast.Constant) for one in node.elts)
    return not listed and not any(isinstance(one, ast.Starred) for one in node.elts)


def called(call):
    """Last name of what is called; empty for a function of a library."""
    if not isinstance(call.func, ast.Name | ast.Attribute):
        return ""
    home, _, name = ast.unparse(call.func).rpartition(".")
    return "" if home.split(".")[0] in LIBRARIES else name


def too_many_parameters(sources):
    """Functions, but for compiled ones and commands, with more parameters than a reader keeps apart."""
    out = []
    for module, text in sources.items():
        for function, compiled in functions_of(ast.parse(text)):
            command = module.startswith("cli.") and any(
                ast.unparse(mark).startswith("app.") for mark in function.decorator_list
            )
            count = len(parameters(function))
            if not compiled and not command and count > MAX_PARAMETERS:
                out.append(f"{module}.{function.name}: {count} parameters (line {function.lineno})")
    return out


def positional_constructions(sources):
    """Objects of the package's classes made of many values without names."""
    trees = {module: ast.parse(text) for module, text in sources.items()}
    classes = {
        node.name for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)
    }
    out = []
    for module, tree in trees.items():
        nodes = [*module_nodes(tree)]
        for function, compiled in functions_of(tree):
            nodes += [] if compiled else own_nodes(function)
        for node in nodes:
            if isinstance(node, ast.Call) and called(node) in classes and len(node.args) > MAX_POSITIONAL:
                out.append(
                    f"{module}.{called(node)}: {len(node.args)} positional values (line {node.lineno})"
                )
    return out


def long_tuples(sources):
    """Tuples of many values that a function returns, or hands to a function of the package."""
    trees = {module: ast.parse(text) for module, text in sources.items()}
    ours = {f.name for tree in trees.values() for f, compiled in functions_of(tree) if not compiled}
    out = []
    for module, tree in trees.items():
        for function, compiled in functions_of(tree):
            for node in [] if compiled else own_nodes(function):
                if isinstance(node, ast.Return) and node.value is not None and is_long(node.value):
                    count = len(node.value.elts)
                    out.append(f"{module}.{function.name}: returns {count} values (line {node.lineno})")
                if isinstance(node, ast.Call) and called(node) in ours:
                    for value in [*node.args, *(word.value for word in node.keywords)]:
                        if is_long(value):
                            out.append(
                                f"{module}.{function.name}: hands {len(value.elts)} values to "
                                f"{called(node)} (line {node.lineno})"
                            )
    return out


def class_names_twice(sources):
    """Public class names that stand for more than one thing."""
    homes = defaultdict(list)
    for module, text in sources.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(module)
    return [f"{name}: {', '.join(where)}" for name, where in homes.items() if len(where) > 1]


CHECKS = (too_many_parameters, positional_constructions, long_tuples, class_names_twice)


def offences(check, sources):
    """What a check finds beyond what is known to be open."""
    return [one for one in check(sources) if one.split(":")[0] not in OPEN]


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_values_have_names(check):
    assert offences(check, package_sources()) == []


ELEVEN = ", ".join("abcdefghijk")


@pytest.mark.parametrize(
    ("check", "source", "count"),
    [
        (too_many_parameters, f"def f({ELEVEN}): pass", 1),
        (too_many_parameters, f"@nb.njit(cache=True)\ndef f({ELEVEN}): pass", 0),
        (positional_constructions, "class A: pass\nA(1, 2, 3, 4, 5, 6, 7)", 1),
        (positional_constructions, "class A: pass\nA(1, 2, 3, 4, 5, 6, x=7)", 0),
        (long_tuples, "def f(): return a, b, c, d", 1),
        (long_tuples, "def f(): return a, b, c", 0),
        (long_tuples, "def f(x): pass\ndef g(): f((a, b, c, d))", 1),
        (long_tuples, "def f(x): pass\ndef g(): f(('a', 'b', 'c', 'd'))", 0),
        (long_tuples, "def g(): np.array((a, b, c, d))", 0),
    ],
)
def test_the_checks_can_fail(check, source, count):
    assert len(check({"scene.x": source})) == count


def test_a_class_name_in_two_modules_is_found():
    sources = {"scene.x": "class A: pass", "track.y": "class A: pass\nclass B: pass"}
    assert class_names_twice(sources) == ["A: scene.x, track.y"]


if __name__ == "__main__":
    for each in CHECKS:
        print(f"## {each.__name__}")
        print("\n".join(offences(each, package_sources())))
