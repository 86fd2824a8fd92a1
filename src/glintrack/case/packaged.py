"""Packaged cases and studies, by name."""

from pathlib import Path

from glintrack.core.designs import suggest_name
from glintrack.core.installation import data_file
from glintrack.io.toml import read_toml
from glintrack.io.untrusted import is_file

PACKAGED_CASES = data_file("cases")


def list_cases() -> list[str]:
    """Names of the packaged cases, which `glintrack run` and `Case.from_name` take."""
    return [name for name in _list_packaged() if not _is_study(name)]


def list_studies() -> list[str]:
    """Names of the packaged studies, which `glintrack study` takes."""
    return [name for name in _list_packaged() if _is_study(name)]


def find_case(name: str | Path, kind: str = "case") -> Path:
    """Find a case or study: a file, or a packaged one by name.

    Parameters
    ----------
    name
        Path of a file, or name of a packaged case or study.
    kind
        ``"case"`` or ``"study"``, for the message that there is none.

    Raises
    ------
    ValueError
        If there is none; the most similar packaged name is suggested.
    """
    path = Path(name)
    if is_file(path) or path.suffix:
        return path
    if str(name) in _list_packaged():
        return PACKAGED_CASES / f"{name}.toml"
    hint = suggest_name(str(name), list_studies() if kind == "study" else list_cases())
    raise ValueError(f"`{kind}` must be a TOML file or the name of a packaged {kind}; got {name}. {hint}")


def _list_packaged() -> list[str]:
    return sorted(path.stem for path in PACKAGED_CASES.glob("*.toml"))


def _is_study(name: str) -> bool:
    return "case" in read_toml(PACKAGED_CASES / f"{name}.toml", "case")  # a study names its base case
