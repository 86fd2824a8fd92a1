"""What ``import glintrack`` offers, and what it does not load before it is needed."""

import json
import re
import subprocess
import sys

import pytest

import glintrack

HEAVY = {"matplotlib", "numba", "rasterio", "xarray", "pandas", "scipy", "pvlib", "numpy", "pydantic", "h5py"}


def loaded_by(code):
    """The heavy libraries that some code loads in a fresh process."""
    text = f"import json, sys\n{code}\nprint(json.dumps(sorted(sys.modules)), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    return HEAVY & {name.split(".")[0] for name in json.loads(done.stderr.splitlines()[-1])}


def test_importing_the_package_loads_nothing_heavy():
    assert loaded_by("import glintrack; dir(glintrack)") == set()


@pytest.mark.parametrize("argument", ["--help", "--version"])
def test_help_and_version_load_nothing_heavy(argument):
    call = f"sys.argv = ['glintrack', *{argument.split()!r}]\nfrom glintrack.cli.app import main"
    assert loaded_by(f"{call}\ntry:\n    main()\nexcept SystemExit:\n    pass") <= {"numpy"}


def test_every_name_loads_and_unknown_names_are_refused():
    assert all(getattr(glintrack, name) is not None for name in glintrack.__all__)
    assert set(glintrack.__all__) <= {*dir(glintrack), "__version__"}
    assert re.fullmatch(r"\d+\.\d+\.\d+", glintrack.__version__)
    with pytest.raises(AttributeError, match="No glintrack attribute simulator"):
        glintrack.simulator  # noqa: B018


def test_the_citation_names_this_version_and_the_paper():
    text = glintrack.citation()
    assert f"version = {{{glintrack.__version__}}}" in text and "10.1117/12.849469" in text
    assert text.count("@") == 2 and text.count("{") == text.count("}")
