"""Write the result folder: tables, rectified frames, pictures, design and provenance."""

import json
import platform
from collections.abc import Hashable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from glintrack.atmosphere import solve_tables
from glintrack.case.design import Case
from glintrack.core.installation import package_version
from glintrack.core.records import Extent
from glintrack.core.schema import CHANNEL_WORDS
from glintrack.devices import PAPER_GRIDS, EtalonDesign, etalon, wire_grid
from glintrack.io.atomic import write_bytes, write_text
from glintrack.io.images import write_figure
from glintrack.io.map_files import TrackGeoreference
from glintrack.io.netcdf import write_tree
from glintrack.io.tables import write_table
from glintrack.io.toml import to_toml
from glintrack.io.tracks import track_table, truth_table, write_tables
from glintrack.results.epoch import BOX_COLUMNS
from glintrack.results.figures import LOOP_STYLES
from glintrack.results.figures import devices as plot_devices
from glintrack.results.figures import sensor as plot_sensor
from glintrack.results.figures import sky as plot_sky
from glintrack.results.figures import tracks as plot_tracks
from glintrack.results.figures.frame import azimuth_of, draw_bearings, on_map
from glintrack.results.film import picture_name
from glintrack.results.froc import flight_froc
from glintrack.results.read import dataset_at
from glintrack.results.recorder import Colour, Recorder
from glintrack.sensor import response_curves
from glintrack.sensor.sensor import ETALON_STEPS

SCORE_COLUMNS = (
    "time_s", "completeness", "completeness_visible", "purity", "tracked_per_km2", "false_tracks",
    "false_per_km2", "should", "valid", "queries_asked", "queries_served", "exposure_ms",
)  # fmt: skip
SKY_WAVELENGTH_UM = 0.55
_DPI = 200  # of pictures
_FINE = 200  # wavelengths of a device's curve
_LIBRARIES = ("numpy", "numba", "xarray", "embreex", "sasktran2", "pvlib")


def write_result(folder: Path, case: Case, tree: xr.DataTree, recorder: Recorder) -> xr.DataTree:
    """Write all files of a result into an existing folder.

    Parameters
    ----------
    folder
        Usually a folder of `io.atomic.result_folder`, with the frames that the recorder wrote.
    case, tree, recorder
        The design, the result of `simulate`, and its recorder.

    Returns
    -------
    Content of ``result.nc``.
    """
    place = _georeference(case, tree, recorder)
    tree = tree.copy()
    tree.attrs |= place.attributes()
    write_text(folder / "case.toml", to_toml(case))
    write_text(folder / "provenance.toml", _provenance(tree))
    whole = _with_record(tree, recorder)
    write_tree(folder / "result.nc", whole)
    write_tables(folder, truth_table(dataset_at(tree, "truth")), "truth", place)
    (folder / "pictures").mkdir()
    if recorder.observer is None:
        return whole
    if case.output.boxes:
        write_table(folder / "boxes.csv", recorder.boxes(), BOX_COLUMNS)
    (folder / "frames").mkdir(exist_ok=True)
    for channel in case.channels:
        write_tables(folder, track_table(dataset_at(tree, f"{channel}/tracks")), f"tracks_{channel}", place)
        scores = dataset_at(tree, channel).rename_dims(time="row").rename_vars(time="time_s")
        write_table(folder / f"scores_{channel}.csv", scores.reset_index("time_s", drop=False), SCORE_COLUMNS)
    _write_film(folder / "film", recorder)
    for name, figure in (*pictures(tree, recorder), *design_pictures(case)):
        write_figure(folder / "pictures" / f"{name}.png", figure, dpi=_DPI)
    return whole


def pictures(tree: xr.DataTree, recorder: Recorder) -> Iterator[tuple[str, Figure]]:
    """Figures of a run, by name."""
    if recorder.colour is not None:
        yield from _views(recorder.case, recorder.colour)
    assert recorder.observer is not None
    bearings = on_map(azimuth_of(recorder.observer.sky.sun_direction))
    if recorder.colour is not None and recorder.colour.ground is not None:
        figure, ax = _figure(9.5, 6)
        plot_tracks.show_rgb(ax, recorder.colour.ground, recorder.observer.city.extent_m)
        ax.set_title(f"{recorder.case.name}: natural colour, rectified")
        draw_bearings(ax, bearings)
        yield "rgb", figure
    truth = dataset_at(tree, "truth")
    for channel, image in recorder.shown.items():
        rows = dataset_at(tree, f"{channel}/tracks")
        time_s = image.attrs["time_s"]
        figure, ax = _figure(10.5, 6.4)
        show = plot_tracks.show_dolp if channel == "dolp" else plot_tracks.show_pan
        show(ax, image)
        plot_tracks.show_missed(ax, truth, rows, time_s)
        plot_tracks.show_tracks(ax, rows, time_s)
        plot_tracks.show_legend(ax)
        ax.set_title(f"{recorder.case.name}: tracks in {CHANNEL_WORDS[channel]} at {time_s:.1f} s")
        draw_bearings(ax, bearings)
        yield channel, figure
    figure, ax = _figure(7, 4)
    plot_tracks.show_completeness(ax, tree)
    yield "completeness", figure


def _georeference(case: Case, tree: xr.DataTree, recorder: Recorder) -> TrackGeoreference:
    """Position and times of tracks and truth; without a CRS if no frame was simulated."""
    if recorder.observer is None:
        return TrackGeoreference(time_zero=case.atmosphere.utc)
    city, times_s = recorder.observer.city, dataset_at(tree, case.channels[0])["time"].values.tolist()
    return TrackGeoreference(
        crs=city.crs,
        origin_m=recorder.origin_m,
        area_m=Extent(*city.extent_m),
        cell_m=case.ortho.gsd_m,
        times_s=times_s,
        time_zero=case.atmosphere.utc,
    )


def _views(case: Case, colour: Colour) -> Iterator[tuple[str, Figure]]:
    """Figures of the aircraft's view in natural colour and DoLP."""
    seen_from = f"from {case.flight.altitude_m:.0f} m, {case.flight.off_nadir_deg:g}° off nadir"
    shown = {
        "rgb": ("natural colour", plot_tracks.show_rgb, colour.view),
        "dolp": ("degree of linear polarization", plot_tracks.show_dolp_view, colour.view_dolp),
    }
    for name, (words, show, picture) in shown.items():
        if picture is None:
            continue
        figure, ax = _figure(8.8, 5.6)
        show(ax, picture)
        ax.set_title(f"{case.name}: {words} {seen_from}")
        if colour.view_bearings is not None:
            draw_bearings(ax, colour.view_bearings)
        yield f"view_{name}", figure


def design_pictures(case: Case) -> Iterator[tuple[str, Figure]]:
    """Figures of the sky and of the devices, by name."""
    tables = solve_tables(case.atmosphere)  # solved before the flight: read from the cache
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    quantities: tuple[plot_sky.Quantity, ...] = ("I", "DoLP", "AoP")
    for k, quantity in enumerate(quantities, start=1):
        axes = figure.add_subplot(1, 3, k, projection="polar")
        shown = plot_sky.fisheye(axes, tables, SKY_WAVELENGTH_UM, quantity)
        figure.colorbar(shown, ax=axes, shrink=0.7, label=plot_sky.LABELS[quantity])
    yield "sky", figure
    figure, ax = _figure(8, 4)
    plot_sky.spectra(ax, tables, case.flight.altitude_m)
    yield "light", figure
    figure, ax = _figure(8, 4)
    plot_sensor.draw_response(ax, response_curves(case.sensor, tables["wavelength"].values))
    yield "elements", figure
    if case.sensor.has_mirror and case.sensor.spectrometer == "etalon":
        figure = Figure(figsize=(10, 4), layout="constrained")
        (left, right), um = figure.subplots(1, 2), np.linspace(*case.sensor.spectrometer_um, _FINE)
        sweep = etalon.responses(EtalonDesign(gap_count=ETALON_STEPS), wavelength_um=um)
        plot_devices.response_map(left, sweep)
        plot_devices.response_curves(right, sweep)
        yield "etalon", figure
    if case.sensor.has_stokes and case.sensor.polarizer in PAPER_GRIDS:
        figure = Figure(figsize=(10, 7), layout="constrained")
        plot_devices.wire_grid_overview(figure, wire_grid.load(case.sensor.polarizer))
        yield "polarizer", figure


def _with_record(tree: xr.DataTree, recorder: Recorder) -> xr.DataTree:
    """Add the vehicles' paints, and each channel's queries, detections and FROC, as groups."""
    nodes = {path: node.to_dataset(inherit=False) for path, node in tree.subtree_with_keys}
    for channel in recorder.case.channels:
        nodes[f"{channel}/queries"] = recorder.queries(channel)
        nodes[f"{channel}/detections"] = recorder.detections(channel)
        if recorder.observer is not None and recorder.grid is not None:
            found, grid, area_of = recorder.found.get(channel, []), recorder.grid, recorder.areas.__getitem__
            truth = dataset_at(tree, "truth")
            nodes[f"{channel}/froc"] = flight_froc(recorder.case, channel, found, truth, grid, area_of)
    nodes["vehicles"] = recorder.vehicles()
    return xr.DataTree.from_dict(nodes)


def _write_film(folder: Path, recorder: Recorder) -> None:
    """Write the pictures of the film and their index."""
    assert recorder.observer is not None
    folder.mkdir()
    city, film = recorder.observer.city, recorder.film
    for (kind, frame), data in film.pictures.items():
        write_bytes(folder / picture_name(kind, frame), data)
    place = {
        "extent_m": list(city.extent_m),
        "crs": city.crs,
        "origin_m": list(recorder.origin_m),
        "channel": recorder.case.channels[0],
    }
    write_text(folder / "film.json", json.dumps(place | film.index(), indent=1) + "\n")


def _figure(width_in: float, height_in: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    return figure, figure.add_subplot()


def _provenance(tree: xr.DataTree) -> str:
    """Versions, wall times and scores of a run, as TOML."""

    def plain(attrs: Mapping[Hashable, Any]) -> dict[str, Any]:
        return {str(k): v.item() if isinstance(v, np.generic) else v for k, v in attrs.items()}

    versions = {"python": platform.python_version(), **{name: package_version(name) for name in _LIBRARIES}}
    scores = {name: plain(tree[name].attrs) for name in LOOP_STYLES if name in tree.children}
    return to_toml({**plain(tree.attrs), **scores, "versions": versions})
