"""``glintrack track``: the tracker on anybody's detections or frames."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
import xarray as xr
from rich.console import Console
from rich.progress import track as progress

from glintrack.case.design import over_like
from glintrack.cli.options import command_app
from glintrack.io import atomic
from glintrack.io.crs import metric_crs, warn_off_map
from glintrack.io.detections import read_detections, read_truth
from glintrack.io.orthoimages import Geotransform, open_frames
from glintrack.io.toml import read_toml
from glintrack.io.tracks import WRITERS, TrackGeoreference, write_tracks
from glintrack.results.roc import ROC_SCORES, roc
from glintrack.track import TrackDesign
from glintrack.track.files import (
    DETECTIONS_DESIGN,
    FRAMES_DESIGN,
    MIN_FRAMES,
    as_rows,
    frames_design,
    strict_design,
    track_detections,
    track_frames,
)

app = command_app()
_FEW_TIMES, _LONG_STEP_S = 4, 10.0
_SEVERAL, _SMALL_M = 1.5, 5.0  # detections a time, and how close together they may be kilometres


@app.command()
def track_files(
    source: Annotated[
        Path,
        typer.Argument(
            help="detections.csv (time_s, east_m, north_m, …), folder of GeoTIFF, PNG or JPEG frames, .nc or "
            ".zarr stack, video"
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help=f"New folder for tracks{', tracks'.join(WRITERS)}"),
    ],
    sigma_m: Annotated[
        float, typer.Option("--sigma-m", help="Standard deviation of a detection without variances [m]")
    ] = 0.5,
    features: Annotated[
        str | None,
        typer.Option(help="Feature columns, with commas; 'none' for none of them [default: all numbers]"),
    ] = None,
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="West, south, east, north of the area [m]; tracks that leave it end"),
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option("--rate", help="Frame rate of frames without times [Hz]")
    ] = None,
    geotransform: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="West and north edge and side of a pixel, for frames that do not say [m]"),
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="Projected CRS of east and north, such as EPSG:32618")
    ] = None,
    channel: Annotated[
        str | None,
        typer.Option(help="What of a frame is searched for change: pan, dolp or all [default: pan]"),
    ] = None,
    design: Annotated[Path | None, typer.Option(help="TOML file with keys of a case's [track] table")] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Only what is measured, and no long waits: purer tracks, fewer")
    ] = False,
    roc_truth: Annotated[
        Path | None,
        typer.Option("--roc", help="truth.csv: sweep the initiation threshold too, into roc.csv"),
    ] = None,
) -> None:
    """Track your own detections or frames.

    The same table of tracks is written in every format; those that are geographic need a CRS.
    """
    if crs is not None:
        metric_crs(crs)
    console = Console()
    swept: list[dict[str, float]] = []
    if source.suffix.lower() == ".csv":
        _check_asked("frames", source, channel=channel, rate=rate_hz, geotransform=geotransform)
        chosen = None if features is None else tuple(n for n in features.split(",") if n not in ("", "none"))
        table = read_detections(source, sigma_m, chosen)
        if table.feature_names:
            console.print(f"features: {', '.join(table.feature_names)}", soft_wrap=True, markup=False)
        wanted = _design(design, DETECTIONS_DESIGN, strict)
        tracked = track_detections(table, wanted, area)
        if tracked.outside:
            box = " ".join(f"{v:.0f}" for v in tracked.area_m)
            swapped = _inside(table.position[:, ::-1], tracked.area_m) > 0.5 * len(table.position)
            asked = (
                "exchanged most lie inside: are east_m and north_m exchanged?" if swapped else "see --area"
            )
            console.print(
                f"left out {tracked.outside} of {len(table.position)} detections outside {box} m ({asked})",
                soft_wrap=True,
            )
        for note in _why_small(table.position, table.time_s):
            console.print(note, soft_wrap=True, markup=False)
        rows, (west, _, _, north) = tracked.rows, tracked.area_m
        place = TrackGeoreference(crs, north_west_m=(west, north), times_s=np.unique(table.time_s).tolist())
        if roc_truth is not None:
            swept = roc(table, read_truth(roc_truth), ROC_SCORES, wanted, area)
    else:
        _check_asked("detections", source, roc=roc_truth, features=features, area=area)
        grid = None if geotransform is None else Geotransform(*geotransform)
        frames = open_frames(source, rate_hz, grid)
        if crs is not None and frames.crs is not None and metric_crs(crs) != metric_crs(frames.crs):
            raise ValueError(f"`crs` must be the frames' own, {frames.crs}, got {crs} (leave --crs out)")
        wanted = frames_design(_changes(design))
        wanted = strict_design(wanted) if strict else wanted
        if channel is not None:
            wanted = wanted.replace({"detect.channel": channel})
        if wanted.detect.channel != "pan" and not frames.dolp:
            raise ValueError(
                f"`channel` must be pan for frames without bands I, Q and U, got {wanted.detect.channel} "
                f"for {source}"
            )
        grids: list[xr.Dataset] = []
        times: set[float] = set()
        reports = progress(
            track_frames(_grid_kept(frames.frames, grids), wanted),
            "tracking",
            frames.count,
            console=console,
            transient=True,
        )
        rows = as_rows(_noting(times, reports))
        times_s = sorted(times)
        if wanted.detect.detector == FRAMES_DESIGN.detect.detector and len(times_s) < MIN_FRAMES:
            raise ValueError(
                f"`frames` must be at least {MIN_FRAMES}, through which a vehicle is seen to move, "
                f"got {len(times_s)} in {source}"
            )
        place = _place_of(grids, crs or frames.crs, times_s)
    _write(console, output, rows, place, swept)
    for note in _why_few(rows, place.times_s):
        console.print(note, soft_wrap=True, markup=False)


def _check_asked(of: str, source: Path, **options: object) -> None:
    """Refuse an option that only the other kind of source heeds."""
    for name, value in options.items():
        if value is not None:
            got = " ".join(map(str, value)) if isinstance(value, tuple) else value
            raise ValueError(f"`{name}` must be asked for with {of}, got {got} for {source}")


def _why_small(position: np.ndarray, time_s: np.ndarray) -> list[str]:
    """A question where several objects a time lie as close together as kilometres taken for metres."""
    if not len(time_s) or len(time_s) < _SEVERAL * len(np.unique(time_s)):
        return []
    across, along = np.ptp(position, axis=0).tolist()
    if max(across, along) >= _SMALL_M:
        return []
    return [f"all detections lie within {across:.2g} m × {along:.2g} m: are east_m and north_m in metres?"]


def _inside(position: np.ndarray, area_m: tuple[float, float, float, float]) -> int:
    """How many places lie in an area."""
    west, south, east, north = area_m
    low, high = np.array([west, south]), np.array([east, north])
    return int(((position >= low) & (position <= high)).all(axis=1).sum())


def _why_few(rows: xr.Dataset, times_s: Sequence[float]) -> list[str]:
    """Why there are no tracks, where the times tell."""
    if rows.sizes.get("row"):
        return []
    if not len(times_s):
        return ["no tracks: there are no detections"]
    if len(times_s) < _FEW_TIMES:
        return [f"no tracks: too few times ({len(times_s)}), a track is confirmed after several"]
    step_s = float(np.median(np.diff(times_s)))
    if step_s > _LONG_STEP_S:
        return [f"no tracks: the times are {step_s:g} s apart, too long to follow vehicles (is time_s in s?)"]
    return ["no tracks: no path has enough detections (--sigma-m, --design; docs/guide/tracking.md)"]


def _noting(
    times: set[float], reports: Iterable[tuple[float, xr.Dataset]]
) -> Iterator[tuple[float, xr.Dataset]]:
    """The same reports, their times noted."""
    for time_s, tracks in reports:
        times.add(time_s)
        yield time_s, tracks


def _grid_kept(
    frames: Iterable[tuple[float, xr.Dataset]], grids: list[xr.Dataset]
) -> Iterator[tuple[float, xr.Dataset]]:
    """The same frames; the coordinates of the first are kept."""
    for time_s, image in frames:
        if not grids:
            grids.append(image[["y", "x"]])
        yield time_s, image


def _place_of(grids: list[xr.Dataset], crs: str | None, times_s: list[float]) -> TrackGeoreference:
    """Where the frames' first pixel lies, and how large it is."""
    if not grids:
        return TrackGeoreference(crs)
    x, y = grids[0]["x"].values, grids[0]["y"].values
    cell = float(abs(x[1] - x[0])) if len(x) > 1 else 1.0
    return TrackGeoreference(crs, (0.0, 0.0), (float(x[0]) - cell / 2, float(y[0]) + cell / 2), cell, times_s)


def _write(
    console: Console,
    output: Path,
    rows: xr.Dataset,
    place: TrackGeoreference,
    swept: list[dict[str, float]],
) -> None:
    if place.crs is not None and rows.sizes.get("row"):
        east_m, north_m = (float(np.median(rows[axis].values)) for axis in ("east", "north"))
        warn_off_map(metric_crs(place.crs), east_m, north_m)
    folder = atomic.ResultFolder(output)
    try:
        names = write_tracks(folder.partial, rows, "tracks", place)
        if swept:
            lines = [",".join(swept[0]), *(",".join(f"{v:.6g}" for v in one.values()) for one in swept)]
            atomic.write_text(folder.partial / "roc.csv", "\n".join(lines) + "\n")
            names = [*names, "roc.csv"]
    except BaseException:
        folder.discard()
        raise
    path = folder.publish()
    count = len(set(rows["track_id"].values.tolist())) if "track_id" in rows else 0
    over = f"{count} {'track' if count == 1 else 'tracks'} over {len(place.times_s)} epochs"
    if count:  # what kilometres taken for metres would show
        width_m, height_m = (float(np.ptp(rows[axis].values)) for axis in ("east", "north"))
        over += f" within {width_m:.3g} m × {height_m:.3g} m"
    console.print(f"wrote {path}: {over} in {', '.join(names)}", soft_wrap=True)


def _design(path: Path | None, default: TrackDesign, strict: bool) -> TrackDesign:
    default = default.replace(_changes(path))
    return strict_design(default) if strict else default


def _changes(path: Path | None) -> dict:
    """What a design file says, by dotted keys."""
    if path is None:
        return {}
    table = over_like(read_toml(path, "design"))
    return _dotted(table.get("track", table))


def _dotted(table: dict, before: str = "") -> dict:
    """Values of nested tables by their dotted keys."""
    out = {}
    for key, value in table.items():
        out |= _dotted(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return out
