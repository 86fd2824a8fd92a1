"""Imports go downward only, and the tracker cannot see truth: the rules as data, checked on syntax trees."""

import ast
from pathlib import Path

import pytest

import glintrack

PACKAGE = Path(glintrack.__file__).parent
VOCABULARY = {"core", "stokes", "camera"}
FILES = VOCABULARY | {"io"}
STAGES = {"flight", "scene", "atmosphere", "devices", "render", "sensor", "ortho", "track", "metrics"}
# part of the package -> the other parts it may import; a module named here has a rule of its own
ALLOWED = {
    "core": set(),
    "stokes": {"core"},
    "camera": {"core"},
    "io": VOCABULARY,
    **{name: FILES for name in STAGES},
    "render": FILES | {"scene", "atmosphere"},
    "sensor": FILES | {"devices"},
    "case": FILES | STAGES,
    "bounds": FILES | {"scene", "render", "sensor", "ortho", "metrics", "track"},
    "bounds.run": FILES | STAGES | {"case", "results", "loop"},
    "bounds.tasks": FILES | STAGES | {"case", "results", "loop"},
    "results.figures": FILES | {"sensor"},
    "results": FILES | STAGES | {"case"},
    "loop": VOCABULARY | STAGES | {"case", "results"},
    "results.run": FILES | STAGES | {"bounds", "case", "loop"},
    "study": FILES | STAGES - {"scene", "track", "ortho", "devices"} | {"bounds", "case", "loop"},
    "dataset": FILES | STAGES | {"case", "results", "loop"},
    "report": FILES | {"bounds", "case", "results", "metrics", "study"},
    "cli": FILES | STAGES | {"bounds", "case", "dataset", "loop", "report", "results", "study"},
    "__main__": {"cli"},
    # the package's own __init__
    "glintrack": VOCABULARY | STAGES | {"case", "loop", "results", "study"},
}


# imports between a package's folders that still go upward; empty it
UPWARD: set[tuple[str, str]] = set()

PAGE = PACKAGE.parents[1] / "docs" / "architecture.md"
BEGIN, END = (
    "<!-- layers: written by python -m tests.architecture.test_layers -->\n",
    "<!-- end of layers -->",
)


def heights(allowed):
    """How many parts lie below each, at the longest; a module's rule counts with its package's."""
    found = {}

    def height(part):
        if part not in found:
            below = {name for name in allowed[part] if name in allowed and name != part}
            found[part] = 1 + max(map(height, below)) if below else 0
        return found[part]

    return {name: height(name) for name in allowed}


def layer_table(allowed):
    """The rules as a table, from the vocabulary upward; parts of one rule share a row."""
    level, rows = heights(allowed), {}
    for name in sorted(allowed, key=lambda name: (level[name], name)):
        rows.setdefault(_in_words(allowed[name]), []).append(f"`{name}`")
    lines = ["| modules | may import |", "| --- | --- |"]
    return [*lines, *(f"| {' '.join(names)} | {imports} |" for imports, names in rows.items())]


def _in_words(imports):
    said = []
    for name, group in (("vocabulary", VOCABULARY), ("every stage", STAGES)):
        if group <= imports:
            said.append(name)
            imports = imports - group
    return ", ".join([*said, *(f"`{name}`" for name in sorted(imports))]) or "nothing of ours"


def write_table():
    """Put the table into its page."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    table = "\n".join(layer_table(ALLOWED))
    PAGE.write_text(f"{before}{BEGIN}{table}\n{END}{rest.split(END)[1]}", encoding="utf-8")


def rule_of(module, allowed):
    """The longest name in ``allowed`` that is the module or a package around it; None if there is none."""
    parts = module.split(".")
    names = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    return next((name for name in names if name in allowed), None)


def own_imports(source, module):
    """((part imported, line, whether inside a function), …) of one module of ours, e.g. ``track.tracker``."""
    tree = ast.parse(source)
    functions = [
        n for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
    ]
    inside = {child for function in functions for child in ast.walk(function)}
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, (ast.Import, ast.ImportFrom, ast.Call)):
            continue
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:  # from . or .. : the package that many levels up
                up = ["glintrack", *module.split(".")][: -node.level]
                base = ".".join([*up, base] if base else up)
            names = [f"{base}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        for name in names:
            head, _, rest = name.partition(".")
            if head == "glintrack":
                hidden = node in inside and not isinstance(node, ast.Call)
                found.append(((rest or "glintrack").split(".")[0], node.lineno, hidden))
    return found


def violations(sources, allowed=None):
    """Every import that goes up, sideways or hides in a function; ``sources`` maps module to text."""
    allowed = ALLOWED if allowed is None else allowed
    out = []
    for module, text in sources.items():
        part, rule = module.split(".")[0], rule_of(module, allowed)
        if rule is None:
            out.append(f"{module}: part `{part}` has no rule")
        for imported, line, hidden in own_imports(text, module):
            if imported != part and imported not in allowed.get(rule or part, ()):
                out.append(f"{module}:{line} imports {imported}")
            if hidden:
                out.append(f"{module}:{line} imports {imported} inside a function")
    return out


def package_sources():
    """Module path -> source, ``track.__init__`` for a package's own."""
    files = {path.relative_to(PACKAGE).with_suffix(""): path for path in PACKAGE.rglob("*.py")}
    names = {".".join(relative.parts): path for relative, path in files.items()}
    return {"glintrack" if n == "__init__" else n: p.read_text(encoding="utf-8") for n, p in names.items()}


def find_cycle(graph):
    """A list of nodes that leads back to its first, or None."""
    done = set()

    def walk(node, trail):
        if node in trail:
            return [*trail[trail.index(node) :], node]
        if node in done:
            return None
        for following in sorted(graph.get(node, ())):
            if cycle := walk(following, [*trail, node]):
                return cycle
        done.add(node)
        return None

    return next((cycle for node in sorted(graph) if (cycle := walk(node, []))), None)


def module_graph(sources):
    """Imports between single modules; a package stands for its ``__init__``."""
    graph = {}
    for module, text in sources.items():
        graph[module] = set()
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.ImportFrom):
                continue
            base = (node.module or "").split(".") if node.module else []
            if node.level:
                base = [*(["glintrack", *module.split(".")][: -node.level]), *base]
            if not base or base[0] != "glintrack":
                continue
            for alias in node.names:
                for target in (".".join([*base[1:], alias.name]), ".".join(base[1:])):
                    target = f"{target}.__init__" if f"{target}.__init__" in sources else target
                    if target in sources and target != module:
                        graph[module].add(target)
                        break
    return graph


def folder_graph(sources):
    """Imports between the sub-folders of a package and its own modules; a sub-folder is one node.

    The package's ``__init__`` is left out: it may import everything below it.
    """
    graph = {}
    for module, imported in module_graph(sources).items():
        node, *others = (".".join(name.split(".")[:2]) for name in (module, *imported))
        within = {other for other in others if other.split(".")[0] == node.split(".")[0]}
        if not node.endswith(".__init__"):
            graph[node] = graph.get(node, set()) | {o for o in within if not o.endswith(".__init__")} - {node}
    return graph


def test_imports_go_downward():
    assert violations(package_sources()) == []


def test_the_page_shows_these_rules():
    shown = PAGE.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0].splitlines()
    assert shown == layer_table(ALLOWED), "write it anew: python -m tests.architecture.test_layers"


def test_every_rule_is_of_a_part_that_exists():
    modules = {module.removesuffix(".__init__") for module in package_sources()}
    assert set(ALLOWED) - modules == set()


def test_rules_have_no_cycle():
    assert find_cycle({part: rule for part, rule in ALLOWED.items() if "." not in part}) is None


def test_modules_have_no_cycle():
    """Within a package its ``__init__`` may import its modules, so it stands above them."""
    assert find_cycle(module_graph(package_sources())) is None


def test_folders_of_a_package_have_no_cycle():
    """Neither two sub-folders nor a sub-folder and a module beside it import each other in a circle."""
    graph = folder_graph(package_sources())
    graph = {node: {other for other in found if (node, other) not in UPWARD} for node, found in graph.items()}
    assert find_cycle(graph) is None


def test_cycles_of_folders_are_found():
    two_ways = {
        "scene.read.osm": "from glintrack.scene.sources.sumo import call",
        "scene.sources.sumo": "from glintrack.scene.read.fcd import read",
        "scene.read.fcd": "",
    }
    assert find_cycle(module_graph(two_ways)) is None
    assert find_cycle(folder_graph(two_ways)) == ["scene.read", "scene.sources", "scene.read"]
    up = {"scene.ground": "from glintrack.scene.objects.mesh import Mesh", "scene.objects.mesh": ""}
    up["scene.objects.layout"] = "from glintrack.scene.ground import STEP_M"
    assert find_cycle(folder_graph(up)) == ["scene.ground", "scene.objects", "scene.ground"]
    up["scene.__init__"] = "from glintrack.scene.objects.layout import Layout"
    up["scene.objects.layout"] = "from glintrack.scene import Layout"
    assert find_cycle(folder_graph(up)) is None


def test_the_tracker_cannot_see_truth():
    for part in ("track", "ortho"):
        assert ALLOWED[part] == FILES
        seen, reach = set(), set(ALLOWED[part])
        while reach:
            name = reach.pop()
            seen.add(name)
            reach |= ALLOWED[name] - seen
        assert not seen & {"scene", "render", "atmosphere", "sensor", "loop", "metrics"}


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("track.tracker", "from glintrack.scene import City", "track.tracker:1 imports scene"),
        ("track.tracker", "from ..scene.traffic import truth_dataset", "imports scene"),
        ("track.tracker", "from glintrack import metrics", "imports metrics"),
        ("track.tracker", "import glintrack.loop as s", "imports loop"),
        ("track.tracker", "import glintrack", "imports glintrack"),
        ("track.__init__", "from .. import scene", "imports scene"),
        ("ortho", "from . import render", "ortho:1 imports render"),
        ("ortho", "from .render.trace import Hits", "imports render"),
        ("metrics", "x = 1\nif x:\n    from glintrack.track import report", "metrics:3 imports track"),
        ("camera", "from .stokes import dolp", "camera:1 imports stokes"),
        ("scene.city", "from ..render import trace", "imports render"),
        ("sensor.design", "from ..render import shade", "imports render"),
        (
            "track.tracker",
            "from importlib import import_module\nimport_module('glintrack.scene')",
            ":2 imports scene",
        ),
        (
            "loop",
            "def run():\n    from .scene import build_scene",
            "loop:2 imports scene inside a function",
        ),
        ("scene.city", "def f():\n    from .objects.geometry import Mesh", "inside a function"),
        ("magic", "import numpy", "part `magic` has no rule"),
    ],
)
def test_the_check_can_fail(module, source, complaint):
    found = violations({module: source})
    assert found and complaint in found[0]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        (
            "track.tracker",
            "from .association import associate\nfrom ..core.records import Track\n"
            "from glintrack.core import schema",
        ),
        ("track.__init__", "from .tracker import start\nfrom glintrack.track.design import TrackDesign"),
        ("render.trace", "from ..scene import Mesh\nimport numpy as np"),
        ("scene.read.sumo", "def run():\n    import libsumo"),
        ("glintrack", "from .case.design import Case"),
    ],
)
def test_the_check_lets_the_rest_pass(module, source):
    assert violations({module: source}) == []


def test_cycles_are_found():
    assert find_cycle({"a": {"b"}, "b": {"c"}, "c": {"a"}}) == ["a", "b", "c", "a"]
    assert find_cycle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) is None
    graph = module_graph({"a": "from .b import x", "b": "from glintrack import a"})
    assert find_cycle(graph) == ["a", "b", "a"]


if __name__ == "__main__":
    write_table()
