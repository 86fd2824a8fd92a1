"""``glintrack track``: track your own detections or frames."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import xarray as xr
from rich.console import Console

from glintrack.case.design import over_like
from glintrack.cli.options import Area, Bar, Corner, argument, command_app, open_console, option, show_wait
from glintrack.core.records import Extent
from glintrack.io import atomic
from glintrack.io.crs import metric_crs, warn_off_map
from glintrack.io.detections import DetectionTable, read_detections, read_truth
from glintrack.io.map_files import TrackGeoreference
from glintrack.io.orthoimages import (
    FrameSource,
    Geotransform,
    leave_out_repeated,
    open_frames,
    read_frame_times,
)
from glintrack.io.readings import report_reading
from glintrack.io.toml import read_toml
from glintrack.io.tracks import WRITERS, track_table, write_tables
from glintrack.ortho.posed_frames import rectify_frames
from glintrack.ortho.stabilization import register_frames, stabilize
from glintrack.report.frames_page import FrameFilm, write_frames_page
from glintrack.results.froc import FROC_SCORES, froc
from glintrack.study.design import flat
from glintrack.track.design import TrackDesign
from glintrack.track.files import (
    DETECTIONS_DESIGN,
    FRAMES_DESIGN,
    MIN_FRAMES,
    TrackedRows,
    as_rows,
    frames_design,
    is_lasting,
    strict_design,
    track_detections,
    track_frames,
)

app = command_app()
_FEW_TIMES = 4
_SEVERAL, _SMALL_M = 1.5, 5.0  # detections per time, and the extent below which they may be in km


@app.command()
def track_files(
    source: Annotated[
        Path, argument("Detections (CSV, MOT .txt), folder of frames, .nc or .zarr stack, or video")
    ],
    output: Annotated[Path, option(f"New folder for tracks{', tracks'.join(WRITERS)}", "-o", "--output")],
    sigma_m: Annotated[float, option("Standard deviation of positions [m]", "--sigma-m")] = 0.5,
    features: Annotated[str | None, option("Feature columns, with commas, or 'none' [default: all]")] = None,
    area: Annotated[
        Area | None, option("West, south, east, north of the tracked area, also with --poses [m]")
    ] = None,
    rate_hz: Annotated[float | None, option("Frame rate if frames have no times [Hz]", "--rate")] = None,
    geotransform: Annotated[Corner | None, option("West and north edge and pixel size of frames [m]")] = None,
    crs: Annotated[str | None, option("Projected CRS of the coordinates, such as EPSG:32618")] = None,
    channel: Annotated[str | None, option("Tracking channel: pan, dolp or all [default: pan]")] = None,
    design: Annotated[Path | None, option("TOML file with keys of a case's [track] table")] = None,
    strict: Annotated[bool, option("No coasted positions: fewer, purer tracks", "--strict")] = False,
    froc_truth: Annotated[Path | None, option("Truth as for score, to write froc.csv", "--froc")] = None,
    uses_stabilization: Annotated[
        bool, option("Stabilize frames of a moving camera first (extra `stabilize`)", "--stabilize")
    ] = False,
    times: Annotated[Path | None, option("CSV file with time_s of each frame [s]", "--times")] = None,
    poses: Annotated[
        Path | None, option("Poses of the frames of a moving camera: CSV file, or folder of NAME.pose.toml")
    ] = None,
    camera: Annotated[Path | None, option("With --poses: camera file, as for ortho")] = None,
    height: Annotated[float | None, option("With --poses: one height for all the ground [m]")] = None,
    dem: Annotated[Path | None, option("With --poses: raster of ground heights [m]")] = None,
    gsd: Annotated[float | None, option("With --poses: cell size [m] [default: a pixel's]")] = None,
    has_page: Annotated[bool, option("Write report.html: film, tracks, counts", "--report")] = False,
) -> None:
    """Track your own detections or frames.

    The table of tracks is written in every format; the geographic formats need a CRS.
    """
    if crs is not None:
        metric_crs(crs)
    console, swept, film = open_console(), list[dict[str, float]](), None
    changes = {} if design is None else over_like(read_toml(design, "design"))
    changes = flat(changes.get("track", changes))
    grid = None if geotransform is None else Geotransform(*geotransform)
    of_poses = {"camera": camera, "height": height, "dem": dem, "gsd": gsd}
    if source.suffix.lower() in (".csv", ".txt"):
        only_frames = {"stabilize": uses_stabilization or None, "report": has_page or None, "times": times}
        only_frames |= {"poses": poses, **of_poses}
        _check_unused("frames", source, channel=channel, **only_frames)
        if source.suffix.lower() == ".csv":
            _check_unused("frames or MOT .txt", source, rate=rate_hz, geotransform=geotransform)
        chosen = None if features is None else tuple(n for n in features.split(",") if n not in ("", "none"))
        table = read_detections(source, sigma_m, chosen, rate_hz, grid)
        tracker = DETECTIONS_DESIGN.replace(changes)
        tracker = strict_design(tracker) if strict else tracker
        with show_wait(console, "tracking"):
            tracked = track_detections(table, tracker, area)
        box, count = " ".join(f"{v:.0f}" for v in tracked.area_m), len(table.time_s)
        gone, notes = {f"outside {box} m": tracked.outside}, _detection_notes(table, tracked)
        report_reading(source, "detections", count, count - tracked.outside, gone, notes)
        rows, times_s = tracked.rows, np.unique(table.time_s)
        west, south, east, north = tracked.area_m
        if rate_hz is not None:  # frames without detections count too
            times_s = np.arange(round(times_s.max(initial=0.0) * rate_hz) + 1) / rate_hz
        at = grid or Geotransform(west, north, 1.0)
        window = Extent(at.west_m, south, east, at.north_m)
        place = TrackGeoreference(crs, area_m=window, cell_m=at.gsd_m, times_s=times_s.tolist())
        if froc_truth is not None:
            swept = froc(table, read_truth(froc_truth, rate_hz, grid), FROC_SCORES, tracker, area)
    else:
        _check_unused("detections", source, froc=froc_truth, features=features)
        if poses is None:
            _check_unused("detections or --poses", source, area=area)
            _check_unused("--poses", source, **of_poses)
        else:
            stabilize_too = uses_stabilization or None
            _check_unused(
                "frames without --poses", source, stabilize=stabilize_too, geotransform=geotransform
            )
        tracker = frames_design(changes | ({} if channel is None else {"detect.channel": channel}))
        tracker = strict_design(tracker) if strict else tracker
        times_s = None if times is None else read_frame_times(times)
        if poses is not None:
            lens, ground = _camera_and_ground(camera, height, dem)
            options = {"crs": crs, "gsd_m": gsd, "area_m": area, "rate_hz": rate_hz, "times_s": times_s}
            frames = rectify_frames(source, lens, poses, ground, **options)
        else:
            frames = open_frames(source, rate_hz, grid, times_s)
        frames = leave_out_repeated(frames, source)
        if crs is not None and frames.crs is not None and metric_crs(crs) != metric_crs(frames.crs):
            raise ValueError(f"`crs` must be the frames' own, {frames.crs}; got {crs}. Leave --crs out.")
        if uses_stabilization:
            again = leave_out_repeated(open_frames(source, rate_hz, grid, times_s), source)
            frames = stabilize_frames(console, source, frames, again)
        film = FrameFilm() if has_page else None
        rows, place = _track_frames(console, source, frames, tracker, film)
        place = replace(place, crs=crs or frames.crs)
    page = None if film is None else partial(write_frames_page, title=source.name, film=film)
    _write(console, output, rows, place, swept, page)
    if not rows.sizes.get("row"):
        console.print(f"no tracks: {_explain_no_tracks(place.times_s)}")


def _camera_and_ground(
    camera: Path | None, height: float | None, dem: Path | None
) -> tuple[Path, Path | float]:
    """Camera file and ground of frames with poses, which are needed."""
    if camera is None:
        raise ValueError("`camera` must be given with --poses; got none. Give --camera FILE.")
    if height is None and dem is not None:
        return camera, dem
    if height is not None and dem is None:
        return camera, height
    got = "none" if dem is None else "both"
    raise ValueError(f"`glintrack track --poses` must get one of --dem and --height; got {got}.")


def stabilize_frames(console: Console, source: Path, frames: FrameSource, again: FrameSource) -> FrameSource:
    """Register all frames, and return them on one grid."""
    images = (image["pan"].values for _, image in frames.frames)
    with Bar(console, transient=True) as bar:
        onto_first = list(bar.track(register_frames(images), frames.count, description="stabilizing"))
    count, lost = len(onto_first), sum(one is None for one in onto_first)
    report_reading(source, "stabilized frames", count, count - lost, {"no match with earlier frames": lost})
    return stabilize(again, onto_first)


def _track_frames(
    console: Console, source: Path, frames: FrameSource, tracker: TrackDesign, film: FrameFilm | None
) -> tuple[xr.Dataset, TrackGeoreference]:
    """Rows of the tracks in frames, and where the frames lie."""
    if tracker.detect.channel != "pan" and not frames.dolp:
        raise ValueError(
            f"`channel` must be pan for frames without bands I, Q and U; got {tracker.detect.channel} "
            f"for {source}."
        )
    first = list(next(((one,) for one in frames.frames), ()))
    images = chain(first, frames.frames)
    with Bar(console, transient=True) as bar:
        images = bar.track(images, frames.count, description="tracking")
        reports = list(track_frames(images if film is None else film.record(images), tracker))
    used_s = sorted({time_s for time_s, _ in reports})
    if tracker.detect.detector == FRAMES_DESIGN.detect.detector and len(used_s) < MIN_FRAMES:
        raise ValueError(
            f"`frames` must be at least {MIN_FRAMES} that differ, so that a vehicle is seen to move; "
            f"got {len(used_s)} in {source}."
        )
    place = TrackGeoreference(times_s=frames.times_s)
    for _, image in first:
        x, y = image["x"].values, image["y"].values
        cell = float(abs(x[1] - x[0])) if len(x) > 1 else 1.0
        place = replace(place, area_m=Extent.of_cells(x, y, cell), cell_m=cell)
    rows = as_rows(reports)
    if tracker.reporting.history and rows.sizes:
        rows = rows.isel(row=is_lasting(rows, used_s[-1]))
    return rows, place


def _check_unused(of: str, source: Path, **options: object) -> None:
    """Refuse options that apply to the other kind of source alone."""
    for name, value in options.items():
        if value is not None:
            got = " ".join(map(str, value)) if isinstance(value, tuple) else value
            raise ValueError(f"`{name}` must be used with {of}; got {got} for {source}.")


def _detection_notes(table: DetectionTable, tracked: TrackedRows) -> list[str]:
    """List the features, and ask about axes that may be exchanged and a unit that may be wrong."""
    notes, position = [], table.position
    if table.feature_names:
        lacking = int((~np.isfinite(table.features).all(axis=1)).sum())
        without = f"; {lacking:,} rows lack one and are associated by position only" if lacking else ""
        notes.append(f"features: {', '.join(table.feature_names)}{without}")
    if tracked.outside:
        west, south, east, north = tracked.area_m
        exchanged = position[:, ::-1]
        inside = ((exchanged >= [west, south]) & (exchanged <= [east, north])).all(axis=1).mean()
        exchange = "exchanged most lie inside: are east_m and north_m exchanged?"
        notes.append(exchange if inside > 0.5 else "--area sets the area")
    if len(position) and len(position) >= _SEVERAL * len(np.unique(table.time_s)):
        across, along = np.ptp(position, axis=0).tolist()
        if max(across, along) < _SMALL_M:
            size = f"{across:.2g} m × {along:.2g} m"
            notes.append(f"all detections lie within {size}: are east_m and north_m in metres?")
    return notes


def _explain_no_tracks(times_s: Sequence[float]) -> str:
    if not len(times_s):
        return "there are no detections"
    if len(times_s) < _FEW_TIMES:
        return f"too few times ({len(times_s)}), a track is confirmed after several"
    return "no path has enough detections (see --sigma-m, --design, docs/guide/tracking.md)"


def _write(
    console: Console,
    output: Path,
    rows: xr.Dataset,
    place: TrackGeoreference,
    swept: list[dict[str, float]],
    write_page: Callable[..., None] | None,
) -> None:
    """Write tracks and FROC curve into a new folder, and print how many tracks there are."""
    count = len(set(rows["track_id"].values.tolist())) if "track_id" in rows else 0
    if place.crs is not None and count:
        east_m, north_m = (float(np.median(rows[axis].values)) for axis in ("east_m", "north_m"))
        warn_off_map(metric_crs(place.crs), east_m, north_m)
    with atomic.result_folder(output) as folder:
        names = write_tables(folder, track_table(rows), "tracks", place)
        if swept:
            lines = [",".join(swept[0]), *(",".join(f"{v:.6g}" for v in one.values()) for one in swept)]
            atomic.write_text(folder / "froc.csv", "\n".join(lines) + "\n")
            names = [*names, "froc.csv"]
        if write_page is not None:
            write_page(folder / "report.html", rows=rows)
            names = [*names, "report.html"]
    over = f"{count} {'track' if count == 1 else 'tracks'} over {len(place.times_s)} frames"
    if count:  # which shows coordinates that are in km
        width_m, height_m = (float(np.ptp(rows[axis].values)) for axis in ("east_m", "north_m"))
        over += f" within {width_m:.3g} m × {height_m:.3g} m"
    console.print(f"wrote {output}: {over} in {', '.join(names)}")
