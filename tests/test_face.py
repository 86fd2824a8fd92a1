"""What ``import glintrack`` offers, and what it does not load before it is needed."""

import ast
import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import glintrack

ROOT = Path(glintrack.__file__).parent
HEAVY = {"matplotlib", "numba", "rasterio", "xarray", "pandas", "scipy", "pvlib", "numpy", "pydantic", "h5py"}
LAZY = [
    "glintrack",
    *(
        ".".join(("glintrack", *path.parent.relative_to(ROOT).parts))
        for path in ROOT.rglob("*/__init__.py")
        if "lazy_names" in path.read_text(encoding="utf-8")
    ),
]
FACE = (
    "Case simulate run load_result Camera Pose build_scene solve_atmosphere render_frame expose "
    "track_detections track_frames score list_cases citation"
).split()


def loaded_by(code):
    """The heavy libraries that some code loads in a fresh process."""
    text = f"import json, sys\n{code}\nprint(json.dumps(sorted(sys.modules)), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    return HEAVY & {name.split(".")[0] for name in json.loads(done.stderr.splitlines()[-1])}


def test_importing_the_package_loads_nothing_heavy():
    assert loaded_by("import glintrack; dir(glintrack)") == set()


@pytest.mark.parametrize("argument", ["--help", "--version", ""])
def test_help_and_version_load_nothing_heavy(argument):
    call = f"sys.argv = ['glintrack', *{argument.split()!r}]\nfrom glintrack.cli.app import main"
    assert loaded_by(f"{call}\ntry:\n    main()\nexcept SystemExit:\n    pass") == set()


def test_a_process_that_solves_a_grid_loads_no_arrays_with_labels():
    pytest.importorskip("ngsolve")
    assert not loaded_by("import glintrack.devices.wire_grid.fem") & {
        "xarray",
        "pandas",
        "numba",
        "scipy.optimize",
    }


@pytest.mark.parametrize("package", LAZY)
def test_names_for_type_checkers_are_those_that_load(package):
    """Each name under TYPE_CHECKING is offered, and is what its home holds, whatever was loaded before."""
    front = import_module(package)
    tree = ast.parse(Path(front.__file__).read_text(encoding="utf-8"))
    guarded = next(n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    stated = {}
    for node in guarded.body:
        assert isinstance(node, ast.ImportFrom)
        stated |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    assert set(front.__all__) == set(stated) <= set(dir(front))
    for name, (home, attribute) in stated.items():
        within = None if home == package else getattr(import_module(home), attribute, None)
        assert getattr(front, name) is (within or import_module(f"{home}.{attribute}"))


@pytest.mark.parametrize("package", LAZY)
def test_no_name_of_a_package_is_hidden_by_a_module(package):
    """A module that is loaded first would stand in the place of what is asked for."""
    front = import_module(package)
    modules = {path.stem for path in Path(front.__file__).parent.iterdir()}
    hidden = {
        name for name in front.__all__ if name in modules and not isinstance(getattr(front, name), ModuleType)
    }
    assert hidden <= ({"simulate"} if package == "glintrack" else set())


def test_the_face_is_whole_and_unknown_names_are_refused():
    assert all(callable(getattr(glintrack, name)) for name in FACE)
    assert re.fullmatch(r"\d+\.\d+\.\d+", glintrack.__version__)
    with pytest.raises(AttributeError, match="no attribute 'simulator'"):
        glintrack.simulator  # noqa: B018


def test_simulate_stays_the_function_when_its_module_is_loaded():
    code = "import glintrack.loop, glintrack; assert callable(glintrack.simulate), glintrack.simulate"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_citation_names_this_version_and_the_paper():
    text = glintrack.citation()
    assert f"version = {{{glintrack.__version__}}}" in text and "10.1117/12.849469" in text
    assert text.count("@") == 2 and text.count("{") == text.count("}")
