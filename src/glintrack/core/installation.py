"""Version, data files and citation of the program, and the shell command that installs a missing extra.

The command depends on the origin of this installation (PEP 610): a clone, an archive or a registry.
``pip install 'glintrack[…]'`` works for a registry alone.
"""

import importlib
import json
import shlex
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote, urlsplit

VERSION = metadata.version("glintrack")


def data_file(*parts: str) -> Path:
    """Path of a file or folder of the package's data."""
    return Path(__file__).parents[1].joinpath("data", *parts)


def read_data(*parts: str) -> dict[str, Any]:
    """Read a TOML file of the package's data."""
    return tomllib.loads(data_file(*parts).read_text(encoding="utf-8"))


def package_version(name: str) -> str:
    """Version of an installed package, or ``not installed``."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def citation() -> str:
    """BibTeX entries of this version of the program, and of the paper that it implements."""
    return data_file("citation.bib").read_text(encoding="utf-8").replace("VERSION", VERSION)


class MissingExtraError(ValueError):
    """A package that a part of the program needs is not installed."""


def require_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """Import a module of an extra.

    Parameters
    ----------
    module
        Dotted name of the module, e.g. ``"stonesoup.types.track"``.
    extra
        Extra of ``pyproject.toml`` that contains it.
    purpose
        Purpose as an infinitive, e.g. ``"read meshes"``.

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
    """Message that an extra is missing, with the command that installs it."""
    line = install_line(extra)
    return f"the extra `{extra}` must be installed to {purpose}; got no package {package}. Run: {line}"


def install_line(extra: str) -> str:
    """Shell command that adds an extra to this installation."""
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
    """URL of the origin of this installation, and its record of PEP 610; no URL for a registry."""
    clone = Path(__file__).parents[3]
    if (clone / "pyproject.toml").is_file():  # runs from its own clone
        return clone.as_uri(), {"dir_info": {"editable": True}}
    try:
        text = metadata.distribution("glintrack").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        text = None
    about = json.loads(text) if text else {}
    return about.get("url"), about
