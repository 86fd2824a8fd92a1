"""Which parts of a result are whole enough to be shown: pictures cut short, tables without a column."""

import struct
from itertools import pairwise
from pathlib import Path

import xarray as xr

from glintrack.results.film import KINDS

_PNG_BEGIN, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_MOST_PICTURE_BYTES = 100_000_000
_LARGEST = 1e12  # seconds since 1970 and eastings are smaller
_PLACE = {"time_s", "east", "north"}
_SPEED = {"east_speed", "north_speed"}
# columns that a table is nothing without, by the last part of its path
_NEEDED = {
    "tracks": _PLACE | _SPEED | {"track_id"},
    "truth": _PLACE | _SPEED | {"vehicle_id"},
    "queries": _PLACE | {"track_id", "vehicle_id", "radiance", "wavelength"},
    "vehicles": {"paint", "vehicle"},
}


def webp_is_whole(path: Path) -> bool:
    """Whether a file is WebP and as long as it says."""
    if not path.is_file() or path.stat().st_size > _MOST_PICTURE_BYTES:
        return False
    with path.open("rb") as file:
        head = file.read(12)
    if len(head) < 12 or head[:4] != b"RIFF" or head[8:] != b"WEBP":
        return False
    return struct.unpack("<I", head[4:8])[0] + 8 <= path.stat().st_size


def png_is_whole(path: Path) -> bool:
    """Whether a file begins and ends as PNG does."""
    least = len(_PNG_BEGIN) + len(_PNG_END)
    if not path.is_file() or not least <= path.stat().st_size <= _MOST_PICTURE_BYTES:
        return False
    with path.open("rb") as file:
        begin = file.read(len(_PNG_BEGIN))
        file.seek(-len(_PNG_END), 2)
        return begin == _PNG_BEGIN and file.read() == _PNG_END


def checked_film(film: dict) -> dict:
    """Plain values of a ``film.json`` with their types made sure.

    Raises
    ------
    ValueError, KeyError, TypeError
        If a value is missing, of another type, or makes no sense.
    """
    kinds, frames = [str(k) for k in film["kinds"]], [int(k) for k in film["frames"]]
    times_s, extent_m = [float(t) for t in film["times_s"]], [float(v) for v in film["extent_m"]]
    if len(times_s) != len(frames) or not all(kind in KINDS for kind in kinds):
        raise ValueError("times, frames and kinds of pictures do not match")
    if not all(abs(figure) <= _LARGEST for figure in (*extent_m, *times_s)):
        raise ValueError("a figure is not finite, or larger than any")
    if len(extent_m) != 4 or not (extent_m[0] < extent_m[2] and extent_m[1] < extent_m[3]):
        raise ValueError("its extent is empty")
    if not 0.01 < (extent_m[2] - extent_m[0]) / (extent_m[3] - extent_m[1]) < 100:
        raise ValueError("its extent is a line")
    if any(after <= before for before, after in pairwise(times_s)) or min(frames, default=0) < 0:
        raise ValueError("its times do not rise, or a frame's number is negative")
    if max(frames, default=0) > _LARGEST:
        raise ValueError("a frame's number is larger than any")
    sure = {"kinds": kinds, "frames": frames, "times_s": times_s, "extent_m": extent_m}
    if not frames:
        return sure
    low, high = (float(v) for v in film["pan_range"])
    limits = {name: float(film[name]) for name in ("dolp_highest", "aop_least_dolp")}
    if not all(abs(figure) <= _LARGEST for figure in (low, high, *limits.values())):
        raise ValueError("a figure is not finite, or larger than any")
    return sure | limits | {"pan_range": [low, high], "channel": str(film.get("channel", ""))}


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
