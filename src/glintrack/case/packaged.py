"""The cases and studies that come with the package, found by name; no library is loaded for it."""

from pathlib import Path

from glintrack.core.designs import suggest_name
from glintrack.io.toml import read_toml
from glintrack.io.untrusted import is_file

PACKAGED_CASES = Path(__file__).parents[1] / "data" / "cases"


def list_cases() -> list[str]:
    """Names of the packaged cases, which `glintrack run` and `Case.named` take."""
    return [name for name in _packaged() if not _is_study(name)]


def list_studies() -> list[str]:
    """Names of the packaged studies, which `glintrack study` takes."""
    return [name for name in _packaged() if _is_study(name)]


def find_case(name: str | Path, kind: str = "case") -> Path:
    """A file as named, or else a packaged case or study of that name.

    Parameters
    ----------
    name
        A file, or a packaged name.
    kind
        What is sought, ``"case"`` or ``"study"``, for the sentence that says there is none.

    Raises
    ------
    ValueError
        If there is neither; the packaged name most like it is offered.
    """
    path = Path(name)
    if is_file(path) or path.suffix:
        return path  # who reads it says what is wrong with it
    if str(name) in _packaged():
        return PACKAGED_CASES / f"{name}.toml"
    hint = suggest_name(str(name), list_studies() if kind == "study" else list_cases())
    raise ValueError(f"`{kind}` must be a TOML file or the name of a packaged {kind}, got {name} ({hint})")


def _packaged() -> list[str]:
    return sorted(path.stem for path in PACKAGED_CASES.glob("*.toml"))


def _is_study(name: str) -> bool:
    return "case" in read_toml(PACKAGED_CASES / f"{name}.toml", "case")  # a study names its base case


def find_packaged_case(name: str) -> Path | None:
    """The file of a packaged case (not of a study), if there is one of exactly that name."""
    return PACKAGED_CASES / f"{name}.toml" if name in list_cases() else None
