"""Read a result folder, whole, half finished or of another version, and show it in a notebook."""

import base64
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import jinja2
import xarray as xr
from PIL import Image

from glintrack.case.design import Case
from glintrack.core.installation import VERSION, data_file, read_data
from glintrack.io.toml import read_toml
from glintrack.io.untrusted import check_netcdf, read_bytes, read_json
from glintrack.results.film import picture_name, validate_film
from glintrack.results.verdict import reservations, verdict

_MAX_CASE_BYTES = 4_000_000
_MAX_PICTURE_BYTES = 100_000_000
_MARKS = ("case.toml", "provenance.toml", "result.nc")
SCORE_LABELS: Mapping[str, str] = read_data("page", "scores.toml")["run"]
_SIDE = 640  # longest side of a card's picture [pixel]
_DASH = "–"
_REQUIRED: Mapping[str, Sequence[str]] = read_data("schemas.toml")["columns"]
T = TypeVar("T")


@dataclass(frozen=True, repr=False)
class Result:
    """Content of a result folder, as far as it exists; a notebook shows its scores and a picture.

    Parameters
    ----------
    path
        The folder.
    tree
        Result of `simulate` with ``/vehicles`` and ``/CHANNEL/queries``, without tables that lack a column;
        None if it is missing.
    case, case_text
        The design, None if this version cannot read it, and its TOML.
    provenance
        Plain values of ``provenance.toml``.
    film
        Plain values of ``film/film.json``; empty if there is no film.
    notes
        Missing or broken parts, one sentence each.
    """

    path: Path
    tree: xr.DataTree | None
    case: Case | None
    case_text: str
    provenance: dict
    film: dict
    notes: tuple[str, ...]

    @property
    def channels(self) -> list[str]:
        """Channels with scores, in their order in the case."""
        if self.tree is None:
            return []
        return [str(name) for name, node in self.tree.children.items() if "completeness" in node]

    @property
    def name(self) -> str:
        """Name of the case, or of the folder if it is not known."""
        return str(self.provenance.get("case", self.path.resolve().name))

    @property
    def scores(self) -> dict[str, dict[str, float]]:
        """Scores of the whole flight, by channel."""
        if self.tree is None:
            return {}
        attrs = {name: self.tree[name].attrs for name in self.channels}
        return {name: {k: float(of[k]) for k in SCORE_LABELS if k in of} for name, of in attrs.items()}

    @property
    def verdict(self) -> str:
        """Completeness, false tracks and largest loss as text; empty without scores."""
        return "" if self.tree is None else verdict(self.tree, self.scores)

    @property
    def reservations(self) -> list[str]:
        """Reservations about the verdict, one sentence each."""
        return [] if self.tree is None else reservations(self.tree, self.scores, self.case)

    def __repr__(self) -> str:
        """One line: name, folder, and completeness and purity of each channel."""
        keys = ("completeness", "purity")
        parts = [
            f"{name}: {', '.join(f'{key} {of.get(key, math.nan):.3g}' for key in keys)}"
            for name, of in self.scores.items()
        ]
        return f"<glintrack result {self.name!r} in {self.path}; {'; '.join(parts) or 'no scores'}>"

    def _repr_html_(self) -> str:
        """HTML for a notebook, without program or style sheet; all text of the result is escaped."""
        pictures = [picture_file(self.path, name) for name in (*self.channels, "rgb", "view_rgb")]
        path = next((path for path in pictures if path is not None), None)
        picture = "" if path is None else picture_url(path, _SIDE)
        template = data_file("page", "card.html.j2").read_text(encoding="utf-8")
        card = jinja2.Environment(autoescape=True).from_string(template)
        return card.render(result=self, rows=score_rows(self.scores), picture=picture, side=_SIDE)


def load_result(path: str | Path) -> xr.DataTree:
    """Read the labelled arrays of a result: scores, tracks, truth, quality, served queries and spectra.

    Parameters
    ----------
    path
        A result folder.

    Returns
    -------
    In memory; groups as `simulate` describes them.

    Raises
    ------
    ValueError
        If the folder is no result, or has no readable ``result.nc``.
    """
    notes: list[str] = []
    tree = _read_tree(_check_folder(path), notes)
    if tree is None:
        raise ValueError(f"`path` must be a finished result; got {path}: {notes[0]}")
    return tree


def read_result(path: str | Path, tree: xr.DataTree | None = None) -> Result:
    """Read all parts of a result folder that exist: arrays, design, provenance and film.

    Parameters
    ----------
    path
        The folder.
    tree
        Content of ``result.nc``, if it has just been written: it is not read.

    Raises
    ------
    ValueError
        If the folder does not exist or contains nothing of a result.
    """
    folder, notes = _check_folder(path), list[str]()
    if tree is None:
        tree = _read_tree(folder, notes)
    if tree is not None:
        tree = _remove_broken_tables(tree, notes)
    case, case_text = _read_case(folder, notes)
    part = folder / "provenance.toml", "versions and wall times are not known"
    provenance = _read_part(part, lambda file: read_toml(file, "provenance.toml"), notes) or {}
    no_frame = bool(provenance.get("interrupted")) and provenance.get("frames_done") == 0
    film = _read_film(folder, [] if no_frame else notes)
    pictures = [film_file(folder, kind, frame) for kind in film.get("kinds", []) for frame in film["frames"]]
    if broken := pictures.count(None):
        notes.append(f"{broken} of the film's {len(pictures)} pictures are missing or broken.")
    for picture in sorted((folder / "pictures").glob("*.png")):
        if not _is_whole(picture):
            notes.append(f"pictures/{picture.name} is broken and not shown.")
    written_by = str(provenance.get("glintrack_version", ""))
    if written_by and written_by != VERSION:
        notes.append(f"Written by glintrack {written_by}, shown by {VERSION}.")
    if provenance.get("interrupted"):
        done, count = provenance.get("frames_done", "?"), provenance.get("frames_asked", "?")
        notes.append(f"The flight was interrupted after {done} of {count} frames.")
    return Result(folder, tree, case, case_text, provenance, film, notes=tuple(notes))


def picture_file(folder: Path, name: str) -> Path | None:
    """Path of a picture of the result; None if it is missing or broken."""
    path = folder / "pictures" / f"{name}.png"
    return path if _is_whole(path) else None


def film_file(folder: Path, kind: str, frame: int) -> Path | None:
    """Path of a picture of the film; None if it is missing or broken."""
    path = folder / "film" / picture_name(kind, frame)
    return path if _is_whole(path) else None


def _check_folder(path: str | Path) -> Path:
    folder, requirement = Path(path), "`result` must be a folder that `glintrack run` wrote"
    if not folder.is_dir():
        raise ValueError(
            f"{requirement}; got {folder}, which {'is a file' if folder.exists() else 'does not exist'}."
        )
    if not any((folder / mark).is_file() for mark in _MARKS):
        if (folder / "study.json").is_file():
            raise ValueError(f"{requirement}; got a study. Show it: `glintrack report {folder}`.")
        raise ValueError(f"{requirement}; got {folder} without any of {', '.join(_MARKS)}.")
    return folder


def _read_part(part: tuple[Path, str], read: Callable[[Path], T], notes: list[str]) -> T | None:
    """Read a file of the result; if it is missing or broken, note that and its consequence."""
    path, consequence = part
    name = "film/film.json" if path.name == "film.json" else path.name
    if not path.is_file():
        notes.append(f"{name} is missing: {consequence}.")
        return None
    try:
        return read(path)
    except Exception as error:  # decoders raise errors of any kind for a damaged file
        reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}."
        notes.append(f"{name} cannot be read: {consequence}. {reason}")
        return None


def _read_tree(folder: Path, notes: list[str]) -> xr.DataTree | None:
    def read(path: Path) -> xr.DataTree:
        check_netcdf(path, "result.nc")
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            return tree.load()

    return _read_part((folder / "result.nc", "there are no tracks and scores"), read, notes)


def _read_case(folder: Path, notes: list[str]) -> tuple[Case | None, str]:
    path, text = folder / "case.toml", ""
    if not path.is_file():
        notes.append("case.toml is missing: the design is not known.")
        return None, text
    try:
        text = read_bytes(path, "case.toml", _MAX_CASE_BYTES).decode("utf-8", errors="replace")
        return Case.from_toml(path, allow_outside_paths=True), text
    except ValueError as error:
        notes.append(f"case.toml is not a case of this version: {error}")
        return None, text


def _read_film(folder: Path, notes: list[str]) -> dict:
    path = folder / "film" / "film.json"
    if not path.is_file():
        notes.append("There is no film: the pictures of the flight are missing.")
        return {}
    part = path, "the pictures of the flight are not shown"
    film = _read_part(part, lambda file: validate_film(read_json(file, "film.json")), notes)
    if film is not None and not film["frames"]:
        notes.append("The run has no film (`output.film_frames` was 0, or it ended too soon).")
    return film or {}


def _is_whole(path: Path) -> bool:
    """Return True if a file is a complete picture."""
    if not path.is_file() or path.stat().st_size > _MAX_PICTURE_BYTES:
        return False
    try:
        with Image.open(path, formats=("PNG", "WEBP")) as picture:
            picture.verify()
    except Exception:  # decoders raise errors of any kind for a damaged file
        return False
    return True


def _remove_broken_tables(tree: xr.DataTree, notes: list[str]) -> xr.DataTree:
    """Remove the tables that lack a column."""
    nodes = {}
    for path, node in tree.subtree_with_keys:
        nodes[path] = node.to_dataset(inherit=False)
        missing = set(_REQUIRED.get(path.rpartition("/")[2], ())) - set(map(str, nodes[path].variables))
        if nodes[path].variables and missing:
            notes.append(
                f"result.nc: the table {path} lacks {', '.join(sorted(missing))} and is not shown. "
                "Another version wrote it, or the file is damaged: simulate the case again."
            )
            nodes[path] = xr.Dataset()
    return xr.DataTree.from_dict(nodes)


def dataset_at(tree: xr.DataTree | None, path: str) -> xr.Dataset:
    """Group of a result; empty if it is missing."""
    try:
        node = None if tree is None else tree[path]
    except KeyError:
        node = None
    return node.to_dataset(inherit=False) if isinstance(node, xr.DataTree) else xr.Dataset()


def score_text(value: float | None) -> str:
    """Score with three digits; a dash if it is missing."""
    return _DASH if value is None or value != value else f"{value:.3g}"


def score_rows(scores: Mapping[str, Mapping[str, float | None]]) -> list[tuple[str, list[str]]]:
    """Label of each score, and its text for each channel."""
    if not scores:
        return []
    return [(label, [score_text(of.get(k)) for of in scores.values()]) for k, label in SCORE_LABELS.items()]


def picture_url(path: Path, longest_side: int) -> str:
    """Encode a picture file as a data URL of a small WebP."""
    with Image.open(path) as picture:
        shown = picture.convert("RGB")
    shown.thumbnail((longest_side, longest_side))
    buffer = io.BytesIO()
    shown.save(buffer, "WEBP", quality=80)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
