"""Read a result folder back, whole, half finished or of another version, and show it in a notebook."""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import xarray as xr
from markupsafe import Markup
from PIL import Image

from glintrack.case.design import Case
from glintrack.io.toml import read_toml
from glintrack.io.untrusted import check_netcdf, read_bytes, read_json
from glintrack.results.film import checked_film, picture_name
from glintrack.results.verdict import reservations, verdict

_LARGEST_CASE_BYTES = 4_000_000
_LARGEST_PICTURE_BYTES = 100_000_000
_MARKS = ("case.toml", "provenance.toml", "result.nc")
SCORE_LABELS: Mapping[str, str] = {
    "held_per_km2": "tracked vehicles per km²",
    "completeness": "completeness of all movers",
    "completeness_visible": "completeness of visible vehicles",
    "custody": "custody",
    "false_per_km2": "false tracks per km²",
    "purity": "track purity",
    "median_time_to_loss_s": "median time to loss [s]",
    "same_track_after_10s": "P(same id after 10 s)",
    "idf1_moving": "IDF1 of moving vehicles",
    "false_per_epoch": "false tracks a frame",
    "identity_switches": "identity switches",
}
_SIDE = 640  # longest side of a card's picture [pixel]
_DASH = "–"
_HEAD = Markup('<div style="max-width:{}px"><strong>{}</strong>')
_NOTE = Markup('<div style="border-left:4px solid #c25000;padding-left:8px">{}</div>')
_VERDICT = Markup("<p>{}</p>")
_PICTURE = Markup('<img alt="{}" src="{}" style="width:100%;height:auto">')
_END = Markup(
    "<div>in <code>{}</code>; arrays: <code>.tree</code>, a page: <code>glintrack report</code></div></div>"
)
_PLACE = {"time_s", "east", "north"}
_SPEED = {"east_speed", "north_speed"}
# columns that a table is nothing without, by the last part of its path
_NEEDED = {
    "tracks": _PLACE | _SPEED | {"track_id"},
    "truth": _PLACE | _SPEED | {"vehicle_id"},
    "queries": _PLACE | {"track_id", "vehicle_id", "radiance", "wavelength"},
    "vehicles": {"paint", "vehicle"},
}


@dataclass(frozen=True, repr=False)
class Result:
    """What lies in a result folder, as far as it is there; a notebook shows its scores and a picture.

    Parameters
    ----------
    path
        The folder.
    tree
        What `simulate` returned, with ``/vehicles`` and ``/CHANNEL/queries``, tables that lack a column left
        out; None if it is missing.
    case, case_text
        The design, None if this version cannot read it, and its TOML.
    provenance
        Plain values of ``provenance.toml``.
    film
        Plain values of ``film/film.json``; empty if there is no film.
    notes
        What is missing or odd, one sentence each.
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
        """Channels that were scored, in the order flown."""
        if self.tree is None:
            return []
        return [str(name) for name, node in self.tree.children.items() if "completeness" in node]

    @property
    def name(self) -> str:
        """What the case was called, else the folder."""
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
        """How well the design keeps track and what limits it; empty where nothing was scored."""
        return "" if self.tree is None else verdict(self.tree, self.scores)

    @property
    def reservations(self) -> list[str]:
        """What keeps the verdict from being the whole answer, a sentence each."""
        return [] if self.tree is None else reservations(self.tree, self.scores, self.case)

    def __repr__(self) -> str:
        """One line: name, folder, and completeness and purity of each channel."""
        keys = ("completeness", "purity")
        said = [
            f"{name}: {', '.join(f'{key} {of.get(key, math.nan):.3g}' for key in keys)}"
            for name, of in self.scores.items()
        ]
        return f"<glintrack result {self.name!r} in {self.path}; {'; '.join(said) or 'no scores'}>"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        pictures = [picture_file(self.path, name) for name in (*self.channels, "rgb", "view_rgb")]
        shown = next((path for path in pictures if path is not None), None)
        return card_html(self.name, self.path, (self.verdict, self.scores), self.notes, shown)


def load_result(path: str | Path) -> xr.DataTree:
    """The labelled arrays of a result: scores, tracks, truth, quality, served queries and their spectra.

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
    folder = _folder(path)
    tree, note = _read_tree(folder)
    if tree is None:
        raise ValueError(f"`path` must be a finished result, got {folder}: {note}")
    return tree


def read_result(path: str | Path, tree: xr.DataTree | None = None) -> Result:
    """A result folder with whatever of it is there: arrays, design, provenance, and what is missing.

    Parameters
    ----------
    path
        The folder.
    tree
        What ``result.nc`` holds, if it has just been written: it is not read.

    Raises
    ------
    ValueError
        If the folder does not exist or holds nothing of a result.
    """
    folder, note = _folder(path), ""
    if tree is None:
        tree, note = _read_tree(folder)
    notes = [note] if note else []
    if tree is not None:
        tree, lacks = sound_part(tree)
        notes += lacks
    case, case_text, note = _read_case(folder)
    notes += [note] if note else []
    provenance, note = _read_provenance(folder)
    notes += [note] if note else []
    film, note = _read_film(folder)
    before_any = bool(provenance.get("interrupted")) and provenance.get("frames_done") == 0
    notes += [note] if note and not before_any else []
    notes += _broken_pictures(folder, film)
    written_by = str(provenance.get("glintrack_version", ""))
    if written_by and written_by != version("glintrack"):
        notes.append(f"Written by glintrack {written_by}, shown by {version('glintrack')}.")
    if provenance.get("interrupted"):
        done, asked = provenance.get("frames_done", "?"), provenance.get("frames_asked", "?")
        notes.append(f"The flight was interrupted after {done} of {asked} frames.")
    return Result(
        path=folder,
        tree=tree,
        case=case,
        case_text=case_text,
        provenance=provenance,
        film=film,
        notes=tuple(notes),
    )


def picture_file(folder: Path, name: str) -> Path | None:
    """A picture of the result, if it is there and whole."""
    path = folder / "pictures" / f"{name}.png"
    return path if _is_whole(path) else None


def film_file(folder: Path, kind: str, frame: int) -> Path | None:
    """A picture of the film, if it is there and whole."""
    path = folder / "film" / picture_name(kind, frame)
    return path if _is_whole(path) else None


def _folder(path: str | Path) -> Path:
    folder, wanted = Path(path), "`result` must be a folder that `glintrack run` wrote"
    if not folder.is_dir():
        raise ValueError(
            f"{wanted}, got {folder}, which {'is a file' if folder.exists() else 'does not exist'}"
        )
    if not any((folder / mark).is_file() for mark in _MARKS):
        if (folder / "study.json").is_file():
            raise ValueError(f"{wanted}, got the study {folder} (its page: glintrack report {folder})")
        raise ValueError(f"{wanted}, got {folder} without any of {', '.join(_MARKS)}")
    return folder


def _broken_pictures(folder: Path, film: dict) -> list[str]:
    """What of the pictures is missing or cut short."""
    wanted = [(kind, frame) for kind in film.get("kinds", []) for frame in film["frames"]]
    broken = sum(film_file(folder, *one) is None for one in wanted)
    notes = [f"{broken} of the film's {len(wanted)} pictures are missing or broken."] if broken else []
    cut = [p.name for p in sorted((folder / "pictures").glob("*.png")) if not _is_whole(p)]
    return [*notes, *(f"pictures/{name} is broken and not shown." for name in cut)]


def _read_tree(folder: Path) -> tuple[xr.DataTree | None, str]:
    path = folder / "result.nc"
    if not path.is_file():
        return None, "result.nc is missing: the run did not finish, so there are no tracks and scores."
    try:
        check_netcdf(path, "result.nc")
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            return tree.load(), ""
    except Exception as error:  # whatever a damaged file makes the decoders say
        return None, f"result.nc cannot be read ({type(error).__name__}): no tracks and scores."


def _read_case(folder: Path) -> tuple[Case | None, str, str]:
    path = folder / "case.toml"
    if not path.is_file():
        return None, "", "case.toml is missing: the design is not known."
    text = ""
    try:
        text = read_bytes(path, "case.toml", _LARGEST_CASE_BYTES).decode("utf-8", errors="replace")
        return Case.from_toml(path, allow_outside_paths=True), text, ""
    except ValueError as error:
        return None, text, f"case.toml is not a case of this version: {error}"


def _read_provenance(folder: Path) -> tuple[dict, str]:
    path = folder / "provenance.toml"
    if not path.is_file():
        return {}, "provenance.toml is missing: versions and wall times are not known."
    try:
        return read_toml(path, "provenance.toml"), ""
    except ValueError as error:
        return {}, f"provenance.toml cannot be read: {error}"


def _read_film(folder: Path) -> tuple[dict, str]:
    path = folder / "film" / "film.json"
    if not path.is_file():
        return {}, "There is no film: the pictures of the flight are missing."
    try:
        film = checked_film(read_json(path, "film.json"))
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        return {}, f"film/film.json cannot be read ({error}): the pictures of the flight are not shown."
    kept = "The run kept no film (`output.film_frames` was 0, or it ended too soon)."
    return film, "" if film["frames"] else kept


def _is_whole(path: Path) -> bool:
    """Whether a file is a picture that is not cut short."""
    if not path.is_file() or path.stat().st_size > _LARGEST_PICTURE_BYTES:
        return False
    try:
        with Image.open(path, formats=("PNG", "WEBP")) as picture:
            picture.verify()
    except Exception:  # whatever a damaged file makes the decoders say
        return False
    return True


def sound_part(tree: xr.DataTree) -> tuple[xr.DataTree, list[str]]:
    """A result without the tables that lack a column, and what was left out."""
    kept, notes = {}, []
    for path, node in tree.subtree_with_keys:
        dataset = node.to_dataset(inherit=False)
        missing = _NEEDED.get(path.rpartition("/")[2], set()) - set(map(str, dataset.variables))
        if dataset.variables and missing:
            notes.append(f"result.nc: the table {path} lacks {', '.join(sorted(missing))} and is not shown.")
            dataset = xr.Dataset()
        kept[path] = dataset
    return xr.DataTree.from_dict(kept), notes


def score_text(value: float | None) -> str:
    """A score to three digits, a dash where there is none."""
    return _DASH if value is None or value != value else f"{value:.3g}"


def score_rows(scores: Mapping[str, Mapping[str, float | None]]) -> list[tuple[str, list[str]]]:
    """One row a score, one column a channel, of the scores of each channel."""
    if not scores:
        return []
    return [
        (label, [score_text(of.get(key)) for of in scores.values()]) for key, label in SCORE_LABELS.items()
    ]


def embedded(path: Path, longest_side: int) -> str:
    """A picture file as the address of a small WebP."""
    with Image.open(path) as picture:
        shown = picture.convert("RGB")
    shown.thumbnail((longest_side, longest_side))
    buffer = io.BytesIO()
    shown.save(buffer, "WEBP", quality=80)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()


def card_html(
    title: str,
    folder: Path,
    answer: tuple[str, Mapping[str, Mapping[str, float | None]]],
    notes: Sequence[str],
    picture: Path | None,
) -> str:
    """HTML of a result without program or style sheet; all text of the result is escaped.

    Parameters
    ----------
    title, folder
        What it is called and where it lies.
    answer
        The verdict, and the scores of each channel by the keys of `SCORE_LABELS`.
    notes
        What is missing or odd.
    picture
        A picture file, or None.
    """
    verdict, scores = answer
    parts = [_HEAD.format(_SIDE, title), *(_NOTE.format(note) for note in notes)]
    if verdict:
        parts.append(_VERDICT.format(verdict))
    if scores:
        heads = Markup("").join(Markup("<th>{}</th>").format(name) for name in scores)
        rows = Markup("").join(
            Markup('<tr><th style="text-align:left;font-weight:normal">{}</th>{}</tr>').format(
                label, Markup("").join(Markup("<td>{}</td>").format(v) for v in values)
            )
            for label, values in score_rows(scores)
        )
        parts.append(Markup("<table><tr><th></th>{}</tr>{}</table>").format(heads, rows))
    if picture is not None:
        parts.append(_PICTURE.format(f"tracks of {title}", embedded(picture, _SIDE)))
    return "".join([*parts, _END.format(str(folder))])
