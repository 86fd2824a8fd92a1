"""Functions behind the commands: simulate a case into a folder, render or expose a frame, score tracks."""

import html
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely
import xarray as xr
from rich.console import Console

from glintrack import metrics
from glintrack.bounds.run import FlightBudget
from glintrack.camera import Camera
from glintrack.case.build import build_scenario, trace_frame
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.progress import listen
from glintrack.core.records import NONE_SERVED
from glintrack.io.atomic import result_folder
from glintrack.io.detections import read_tracks, read_truth
from glintrack.io.orthoimages import Geotransform
from glintrack.io.photographs import PlacedPose
from glintrack.loop import case_navigation_errors, frame_rngs, simulate, with_visibility
from glintrack.render import visible_fraction
from glintrack.render.frame import FrameView, Product, render_product
from glintrack.results.epoch import Epoch, SceneView, label_mask, vehicle_boxes
from glintrack.results.read import Result, read_result
from glintrack.results.recorder import Recorder
from glintrack.results.write import write_result
from glintrack.sensor import Sensor, build_sensor, navigate, smear
from glintrack.sensor import expose as expose_light
from glintrack.track import Detector


def as_case(case: Case | str | Path) -> Case:
    """Case from a case, its file, or the name of a packaged one."""
    return case if isinstance(case, Case) else Case.from_toml(find_case(case))


def run(
    case: Case | str | Path = "quickstart",
    output: str | Path | None = None,
    callback: Callable[[Epoch], None] | None = None,
    detectors: Mapping[str, Detector] | None = None,
) -> Result:
    """Simulate a case and write a result folder; the function behind ``glintrack run``.

    A notebook shows a progress bar below the cell.

    Parameters
    ----------
    case
        The design, its file, or the name of a packaged one.
    output
        New folder, ``result-NAME`` by default; it appears whole or not at all.
    callback
        Called after each frame and channel, as by `simulate`.
    detectors
        Your own detectors by channel, as for `simulate`.

    Returns
    -------
    Content of the folder, with scores, tracks and truth in ``tree``. An interrupt (Ctrl-C) ends the flight
    early and saves the frames done.
    """
    design = as_case(case)
    path = Path(output) if output is not None else Path(f"result-{design.name}")
    with result_folder(path) as folder:
        recorder, steps = Recorder(design, folder), FlightBudget(design)
        with _notebook_bar(design.flight.frames) as show:

            def measure(epoch: Epoch) -> None:
                recorder.record(epoch)
                steps.measure(epoch)
                show(epoch)
                if callback is not None:
                    callback(epoch)

            tree = simulate(design, measure, detectors=detectors, on_image=recorder.picture)
        if tree.attrs["interrupted"]:
            frames = int(tree.attrs["frames_done"])
            recorder.end_at(frames)
            steps.end_at(frames)
        if budgets := steps.budgets(tree):
            bound = xr.DataTree(children={group: xr.DataTree(one) for group, one in budgets.items()})
            tree = tree.assign({"bound": bound})
        written = write_result(folder, design, tree, recorder)
    return read_result(path, written)


@contextmanager
def _notebook_bar(frames: int) -> Iterator[Callable[[Epoch], None]]:
    """Show a progress bar below the cell of a notebook, and nothing elsewhere.

    Yields
    ------
    Function to call after each frame and channel. The library's steps (`core.progress.step`) are shown too.
    """
    if not Console().is_jupyter:
        yield lambda epoch: None
        return
    display, done = importlib.import_module("IPython.display"), 0
    shown = display.display(display.HTML(""), display_id=True)

    def update(step: str = "") -> None:
        bar = f'<progress value="{done}" max="{frames}"></progress> {done} of {frames} frames'
        shown.update(display.HTML(f"{bar} {html.escape(step)}"))

    def show(epoch: Epoch) -> None:
        nonlocal done
        if epoch.index >= done:
            done = epoch.index + 1
            update()

    with listen(update):
        update()
        yield show


def render_frame(
    case: Case | str | Path = "quickstart",
    frame: int = 0,
    product: Product = "rgb",
    bands_um: tuple[tuple[float, float], ...] = (),
    ortho: bool = False,
    gsd_m: float | None = None,
) -> xr.DataArray:
    """Render one frame at the lens; the function behind ``glintrack render``.

    Parameters
    ----------
    case, frame
        The design, its file or the name of a packaged one, and the frame of its flight, from 0.
    product
        ``rgb``, ``radiance`` (I, Q, U), ``dolp`` or ``aop``.
    bands_um
        Means over these bands; the sensor's panchromatic one by default. Not for ``rgb``. [µm]
    ortho, gsd_m
        Whether to rectify onto the ground grid, and its cell instead of the case's. [m]

    Returns
    -------
    Dims y, x and, where there are several, band and stokes or rgb; on the ground grid with coordinates.
    [1 for a picture and DoLP, rad for AoP, W m⁻² sr⁻¹ µm⁻¹ else]
    """
    layout, values = render_product(trace_frame(as_case(case), frame, ortho, gsd_m), product, bands_um)
    dims, coords = ["y", "x"], {}
    pairs = ((layout.channel_dim, layout.channels), (layout.component_dim, layout.components))
    for axis, (dim, names) in zip((2, -1), pairs, strict=True):
        if dim:
            dims.append(dim)
            coords[dim] = list(names)
        else:
            values = np.take(values, 0, axis=axis)
    attrs: dict = {"units": layout.units, **dict(layout.attributes)}
    if layout.stokes_frame:
        attrs["stokes_frame"] = layout.stokes_frame
    if layout.place is not None:
        place = layout.place
        coords["x"] = place.west_m + place.gsd_m * (np.arange(layout.columns) + 0.5)
        coords["y"] = place.north_m - place.gsd_m * (np.arange(layout.rows) + 0.5)
        attrs["crs"] = place.crs
    return xr.DataArray(values, coords, dims, layout.name, attrs)


def label_frame(case: Case | str | Path = "quickstart", frame: int = 0) -> xr.Dataset:
    """Label one frame of a case: box of each vehicle, and the vehicle of each element.

    Parameters
    ----------
    case, frame
        The design, its file or the name of a packaged one, and the frame of its flight, from 0.

    Returns
    -------
    Boxes of `results.epoch.vehicle_boxes`, and ``mask`` (y, x): a vehicle's id, −1 for none.

    Raises
    ------
    ValueError
        If the flight has no such frame.
    """
    design = as_case(case)
    if not 0 <= frame < design.flight.frames:
        raise ValueError(f"`frame` must lie in the flight's 0 to {design.flight.frames - 1}; got {frame}.")
    scenario = build_scenario(design)
    observer, times_s = scenario.observer, scenario.flight.times_s
    pose, now = scenario.flight.pose(times_s[frame]), scenario.city.at(times_s[frame])
    errors = case_navigation_errors(design, times_s)
    seen = visible_fraction(now, observer.camera, pose, observer.tracer, observer.vehicle_tracer)
    truth = with_visibility(scenario.city.truth(times_s[frame]), now.vehicle_id[now.fixed :], seen)
    view = SceneView(observer, now, truth, pose, navigate(pose, errors[frame]))
    return vehicle_boxes(view).assign(mask=label_mask(view))


@dataclass(frozen=True)
class Exposure:
    """One frame of superpixels with its camera, for `rectify`.

    Parameters
    ----------
    frame
        Schema ``frame``. [W m⁻² sr⁻¹ µm⁻¹]
    camera, pose
        Camera and true pose.
    sensor
        The sensor.
    """

    frame: xr.Dataset
    camera: Camera
    pose: PlacedPose
    sensor: Sensor


def expose(case: Case | str | Path = "quickstart", frame: int = 0) -> Exposure:
    """Expose one frame of a case, without queries; the function behind ``glintrack sensor expose``."""
    design = as_case(case)
    return expose_view(design, trace_frame(design, frame))


def expose_view(case: Case, view: FrameView) -> Exposure:
    """Expose a traced frame with the sensor of a case."""
    sensor = build_sensor(case.sensor, view.sky.wavelength_um)
    noise = frame_rngs(case.seed, view.frame).noise
    exposed = expose_light(smear(view.radiance, view.motion), sensor, NONE_SERVED, noise, view.time_s)
    city = view.city
    pose = PlacedPose(view.pose, city.crs, (city.origin_easting_m, city.origin_northing_m))
    return Exposure(exposed, sensor.camera, pose, sensor)


def score(
    tracks: xr.Dataset | str | Path,
    truth: xr.Dataset | str | Path,
    area_m: tuple[float, float, float, float] | None = None,
    match_distance_m: float = metrics.MATCH_DISTANCE_M,
    moving_speed_m_s: float = metrics.MOVING_SPEED_M_S,
    rate_hz: float | None = None,
    grid: Geotransform | None = None,
) -> dict[str, float]:
    """Score tracks against the truth; the function behind ``glintrack score``.

    Parameters
    ----------
    tracks, truth
        CSV files with ``time_s``, ``track_id`` or ``vehicle_id``, ``east_m``, ``north_m``, or their rows, as
        ``load_result(…)["pan/tracks"].to_dataset()``.
    area_m
        West, south, east, north; vehicles and tracks outside do not count. By default as for
        `metrics.score_rows`. [m]
    match_distance_m, moving_speed_m_s
        Maximum distance of a track from its vehicle, and minimum speed of scored vehicles. [m, m s⁻¹]
    rate_hz, grid
        Frame rate [Hz] and position of the pixels of files in MOTChallenge text, see `io.tracks.read_mot`.
    """
    rows = tracks if isinstance(tracks, xr.Dataset) else read_tracks(Path(tracks), rate_hz, grid)
    known = truth if isinstance(truth, xr.Dataset) else read_truth(Path(truth), rate_hz, grid)
    area = None if area_m is None else shapely.box(*area_m)  # tracks beyond it are not false, as in a polygon
    return metrics.score_rows(rows, known, area, match_distance_m, moving_speed_m_s)


KERNELS = 400  # that the warm-up compiles, about


def compile_kernels() -> None:
    """Compile the kernels of a simulation by a short one of `quickstart`; see ``glintrack warm-up``."""
    with TemporaryDirectory() as folder:
        run(as_case("quickstart").replace({"flight.frames": 6}), Path(folder) / "result")
