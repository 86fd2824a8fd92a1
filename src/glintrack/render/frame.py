"""One frame at the lens, before any sensor: channels in one piece, or a cube in blocks.

Radiance is the mean over a band at the lens, per µm, while the sensor's own bands weight photons. In camera
geometry Stokes vectors are in the ``detector`` frame, on the ground grid in ``meridian``.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.colour import colour_channels, natural_colour
from glintrack.core.records import GroundPlace, RasterLayout
from glintrack.core.schema import RADIANCE
from glintrack.core.spectral import band_response, channel_weights
from glintrack.render.light.sky import Sky
from glintrack.render.observer import FrameRadiance, Observer
from glintrack.render.shading.hits import Hits
from glintrack.scene import City
from glintrack.stokes import aop, dolp

Product = Literal["rgb", "radiance", "dolp", "aop"]
STOKES = ("I", "Q", "U")
BLOCK_BYTES = 8_000_000  # of a cube in camera geometry
ORTHO_BLOCK_BYTES = 64_000_000  # of frames to be rectified: each block shades the whole frame
_TABLE_WIDTH_UM = 0.01  # every value of the atmosphere's tables is a mean over 10 nm


@dataclass(frozen=True)
class GroundGrid:
    """Ground grid of a rectified frame.

    Parameters
    ----------
    rows, columns, place
        Numbers of cells, and their place.
    rectify
        Resamples light (y, x, channel, stokes) in the ``detector`` frame to it, in the ``meridian`` frame.
    """

    rows: int
    columns: int
    place: GroundPlace
    rectify: Callable[[Float[Array, "y x channel stokes"]], Float[Array, "north east channel stokes"]]


@dataclass(frozen=True)
class FrameView:
    """A traced frame, for products in any band.

    Parameters
    ----------
    observer, pose
        Observer and its true pose.
    radiance
        Light at the lens, as for `sensor.expose`.
    frame, time_s
        Number of the frame in the flight, and its time. [s]
    band_um
        Default band of `render_product`. [µm]
    motion
        Path of the image over the exposure, from `sensor.image_motion`. [element]
    grid
        Ground grid of rectified frames; None for camera geometry.
    """

    observer: Observer
    pose: Pose
    radiance: FrameRadiance
    frame: int
    time_s: float
    band_um: tuple[float, float]
    motion: Float[Array, "sample 2"]
    grid: GroundGrid | None = None

    @property
    def city(self) -> City:
        """The scene."""
        return self.observer.city

    @property
    def sky(self) -> Sky:
        """Sky and sun."""
        return self.observer.sky

    @property
    def camera(self) -> Camera:
        """The frame camera."""
        return self.observer.camera

    @property
    def hits(self) -> Hits:
        """Hits of the frame's rays."""
        return self.radiance.hits

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the products."""
        cells = self.grid or self.camera
        return cells.rows, cells.columns


def render_product(
    view: FrameView, product: Product, bands_um: tuple[tuple[float, float], ...] = ()
) -> tuple[RasterLayout, Float[Array, "y x channel component"]]:
    """Render a picture in natural colour, or radiance (I, Q, U), DoLP or AoP in some bands.

    Parameters
    ----------
    view
        The traced frame.
    product
        Name of the product. ``rgb`` has no bands.
    bands_um
        Bands; by default the sensor's panchromatic one. [µm]

    Returns
    -------
    Layout of a file, and its values; NaN without data. [W m⁻² sr⁻¹ µm⁻¹, 1 or rad]

    Raises
    ------
    ValueError
        If a band is not within the atmosphere's tables or holds none of their wavelengths.
    """
    sky = view.sky
    if product == "rgb":
        if sky.wavelength_um[0] > 0.45 or sky.wavelength_um[-1] < 0.65:
            raise ValueError(
                "`--rgb` must have the atmosphere's tables over 0.45 to 0.65 µm; got "
                f"{sky.wavelength_um[0]:g} to {sky.wavelength_um[-1]:g} µm."
            )
        weights = colour_channels(sky.wavelength_um)
        picture = natural_colour(_stokes(view, weights)[..., 0], view.observer.white(weights))
        values = picture.astype(np.float32)[:, :, None]
        return _layout(view, "rgb", "1", ("",), "colour", ("red", "green", "blue")), values
    bands_um = bands_um or (view.band_um,)
    for band in bands_um:
        _check_band(sky, band)
    responses = [band_response(*band, sky.wavelength_um) for band in bands_um]
    values = _stokes(view, channel_weights(sky.wavelength_um, np.stack(responses)))
    components, component_dim, units = STOKES, "stokes", RADIANCE
    if product == "dolp":
        values, components, component_dim, units = dolp(values)[..., None], ("",), "", "1"
    elif product == "aop":
        angle = np.where(values[..., 0] > 0, aop(np.nan_to_num(values)), np.nan)  # without light none
        values, components, component_dim, units = angle[..., None], ("",), "", "rad"
    labels = tuple(f"{a:g}-{b:g} um" for a, b in bands_um)
    layout = _layout(view, product, units, labels, component_dim, components, bands_um)
    return layout, values.astype(np.float32)


def cube_layout(view: FrameView, range_um: tuple[float, float] | None = None) -> RasterLayout:
    """Layout of a file of the full spectral cube; arguments as of `cube_blocks`."""
    wavelength, (rows, columns) = view.sky.wavelength_um[_in_range(view.sky, range_um)], view.shape
    channels = len(wavelength)
    if view.grid is None:
        block = (max(BLOCK_BYTES // (12 * columns * channels), 1), channels)
    else:
        larger = max(rows * columns, view.camera.rows * view.camera.columns)
        block = (rows, max(ORTHO_BLOCK_BYTES // (12 * larger), 1))
    names = tuple(f"{x:.3f} um" for x in wavelength)
    return replace(
        _layout(view, "radiance", RADIANCE, names, "stokes", STOKES),
        channel_dim="wavelength",
        block=block,
        wavelength_um=tuple(wavelength.tolist()),
        width_um=(_TABLE_WIDTH_UM,) * channels,
    )


def cube_blocks(
    view: FrameView, layout: RasterLayout, range_um: tuple[float, float] | None = None
) -> Iterator[tuple[int, int, Float[Array, "y x channel stokes"]]]:
    """Render the cube block by block: (first row, first channel, values), each of `layout.block`.

    Parameters
    ----------
    view
        The traced frame.
    layout
        From `cube_layout`.
    range_um
        Range of wavelengths, both ends included; all by default. [µm]

    Notes
    -----
    In camera geometry a block is some rows with all wavelengths. On the ground grid, with rows from the whole
    frame, it is some wavelengths with all rows.
    """
    sky = view.sky
    chosen = _in_range(sky, range_um)
    rows, channels = layout.block
    if view.grid is not None:
        weights = np.eye(len(sky.wavelength_um))[chosen]
        for channel in range(0, len(weights), channels):
            yield 0, channel, _stokes(view, weights[channel : channel + channels])
        return
    wavelength_um = sky.wavelength_um[chosen]
    for row, light in view.radiance.blocks(wavelength_um=wavelength_um, rows=rows):
        yield row, 0, light.values


def _stokes(view: FrameView, weights: Array) -> Float[Array, "y x channel stokes"]:
    light = view.radiance(weights).values
    return light if view.grid is None else view.grid.rectify(light)


def _in_range(sky: Sky, range_um: tuple[float, float] | None) -> Array:
    """Mask of the wavelengths of the tables in a range."""
    table = sky.wavelength_um
    low, high = range_um or (table[0], table[-1])
    if range_um is not None:
        _check_band(sky, range_um)
    return (table >= low - 1e-9) & (table <= high + 1e-9)


def _check_band(sky: Sky, band_um: tuple[float, float]) -> None:
    low, high = band_um
    table = sky.wavelength_um
    if not table[0] - 1e-9 <= low < high <= table[-1] + 1e-9:
        raise ValueError(
            f"`--band` must rise within the atmosphere's {table[0]:g} to {table[-1]:g} µm; "
            f"got {low:g}:{high:g}. Set atmosphere.wavelength_stop_um to extend them."
        )
    if not ((table >= low - 1e-9) & (table <= high + 1e-9)).any():
        nearest = float(table[np.argmin(np.abs(table - 0.5 * (low + high)))])
        raise ValueError(
            f"`--band` must hold at least one of the atmosphere's wavelengths; got {low:g}:{high:g}. "
            f"The nearest is {nearest:g} µm."
        )


def _layout(
    view: FrameView,
    name: str,
    units: str,
    channels: tuple[str, ...],
    component_dim: str,
    components: tuple[str, ...],
    bands_um: tuple[tuple[float, float], ...] = (),
) -> RasterLayout:
    (rows, columns), pose = view.shape, view.pose
    facts = {"frame": view.frame, "time_s": view.time_s, "lens_east_m": round(pose.east_m, 3)}
    facts |= {"lens_north_m": round(pose.north_m, 3), "lens_up_m": round(pose.up_m, 3)}
    stokes_frame = "detector" if view.grid is None else "meridian"
    return RasterLayout(
        name=name,
        units=units,
        rows=rows,
        columns=columns,
        channel_dim="band" if len(channels) > 1 else "",
        channels=channels,
        component_dim=component_dim,
        components=components,
        block=(rows, len(channels)),
        wavelength_um=tuple(0.5 * (a + b) for a, b in bands_um),
        width_um=tuple(b - a for a, b in bands_um),
        stokes_frame="" if name in ("rgb", "dolp") else stokes_frame,
        place=view.grid and view.grid.place,
        attributes=tuple(facts.items()),
    )
