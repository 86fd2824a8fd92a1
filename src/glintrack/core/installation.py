"""The program's version, how to cite it, and optional packages: the line that installs the missing ones.

The line names where this installation came from (PEP 610): a clone, an archive or a registry. Each installs
its extras differently, and ``pip install 'glintrack[…]'`` works for the last alone.
"""

import importlib
import json
import shlex
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote, urlsplit

VERSION = metadata.version("glintrack")
_BIBTEX = """\
@software{{glintrack,
  title   = {{glintrack: an open simulator of imaging sensors and vehicle tracking}},
  author  = {{{{The glintrack authors}}}},
  version = {{{version}}},
  license = {{BSD-3-Clause}}
}}
@inproceedings{{presnar2010,
  title     = {{Dynamic scene generation, multimodal sensor design, and target tracking demonstration for
               hyperspectral/polarimetric performance-driven sensing}},
  author    = {{Presnar, Michael D. and Raisanen, Alan D. and Pogorzala, David R. and Kerekes, John P. and
               Rice, Andrew C.}},
  booktitle = {{Proc. SPIE 7672: Polarization: Measurement, Analysis, and Remote Sensing IX}},
  pages     = {{76720T}},
  year      = {{2010}},
  doi       = {{10.1117/12.849469}}
}}
"""


def citation() -> str:
    """What to cite, as BibTeX: this version of the program, and the paper whose chain it follows."""
    return _BIBTEX.format(version=VERSION)


class MissingExtraError(ValueError):
    """A part of the program needs a package that is not installed."""


def require_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """Import a module that an extra brings.

    Parameters
    ----------
    module
        Dotted name of the module, e.g. ``"stonesoup.types.track"``.
    extra
        The extra of ``pyproject.toml`` that brings it.
    purpose
        What it is needed for, as an infinitive, e.g. ``"read meshes"``.

    Raises
    ------
    MissingExtraError
        If it cannot be imported; says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(missing_extra(module.split(".")[0], extra, purpose)) from error


def missing_extra(package: str, extra: str, purpose: str) -> str:
    """The sentence that says which extra is missing, and how to install it."""
    line = install_line(extra)
    return f"the extra `{extra}` must be installed to {purpose}, got no package {package} ({line})"


def install_line(extra: str) -> str:
    """A shell command that adds an extra to this installation, for the Python that runs."""
    pip = f"{shlex.quote(sys.executable or 'python3')} -m pip install"
    url, about = _origin()
    if url is None:
        return f"{pip} {shlex.quote(f'glintrack[{extra}]')}"
    parts = urlsplit(url)
    clone = Path(unquote(parts.path))
    if parts.scheme == "file" and (clone / "pyproject.toml").is_file():
        constraints = clone / "constraints.txt"
        pinned = f" -c {shlex.quote(str(constraints))}" if constraints.is_file() else ""
        editable = " -e" if about.get("dir_info", {}).get("editable") else ""
        return f"{pip}{pinned}{editable} {shlex.quote(f'{clone}[{extra}]')}"
    if "vcs_info" in about:
        url = f"{about['vcs_info']['vcs']}+{url}@{about['vcs_info']['commit_id']}"
    return f"{pip} {shlex.quote(f'glintrack[{extra}] @ {url}')}"


def _origin() -> tuple[str | None, dict]:
    """Where this installation came from: its URL and what PEP 610 says of it; no URL for a registry."""
    clone = Path(__file__).parents[3]
    if (clone / "pyproject.toml").is_file():  # runs from its own clone
        return clone.as_uri(), {"dir_info": {"editable": True}}
    try:
        text = metadata.distribution("glintrack").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        text = None
    about = json.loads(text) if text else {}
    return about.get("url"), about
