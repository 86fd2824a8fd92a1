"""One frame as the lens receives it, before any sensor: channels at once, or a cube in blocks.

Radiance is the mean over a band of what reaches the lens, per µm; the sensor's own bands weigh photons.
In camera geometry Stokes vectors are in the ``detector`` frame, on the ground grid in ``meridian``.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.colour import colour_channels, natural_colour
from glintrack.core.records import GroundPlace, RasterLayout
from glintrack.core.schema import RADIANCE
from glintrack.core.spectral import Band, channel_weights
from glintrack.render.light.sky import Sky
from glintrack.render.observer import FrameRadiance, Observer
from glintrack.render.shading.hits import Hits
from glintrack.scene import City
from glintrack.stokes import aop, dolp

Product = Literal["rgb", "radiance", "dolp", "aop"]
STOKES = ("I", "Q", "U")
BLOCK_BYTES = 8_000_000  # of a cube in camera geometry held at a time
ORTHO_BLOCK_BYTES = 64_000_000  # of frames to be rectified: each block shades the whole frame anew
_TABLE_WIDTH_UM = 0.01  # every value of the atmosphere's tables is a mean over 10 nm


@dataclass(frozen=True)
class GroundGrid:
    """Ground grid that a frame may be laid on.

    Parameters
    ----------
    rows, columns, place
        Its cells, and where they lie.
    rectify
        What lays light (y, x, channel, stokes) in the ``detector`` frame on it, in the ``meridian`` frame.
    """

    rows: int
    columns: int
    place: GroundPlace
    rectify: Callable[[Float[Array, "y x channel stokes"]], Float[Array, "north east channel stokes"]]


@dataclass(frozen=True)
class FrameView:
    """One frame, ready to be asked for any band.

    Parameters
    ----------
    observer, pose
        What looks at it, from which true pose.
    radiance
        Light that reaches the lens, as `sensor.expose` takes it.
    frame, time_s
        Which frame of the flight, and when. [s]
    band_um
        The band of `render_product` if none is asked for. [µm]
    grid
        Ground grid if frames are rectified; None for camera geometry.
    """

    observer: Observer
    pose: Pose
    radiance: FrameRadiance
    frame: int
    time_s: float
    band_um: tuple[float, float]
    grid: GroundGrid | None = None

    @property
    def city(self) -> City:
        """What is looked at."""
        return self.observer.city

    @property
    def sky(self) -> Sky:
        """By which light."""
        return self.observer.sky

    @property
    def camera(self) -> Camera:
        """Through what."""
        return self.observer.camera

    @property
    def hits(self) -> Hits:
        """What its rays meet."""
        return self.radiance.hits


def render_product(
    view: FrameView, product: Product, bands_um: tuple[tuple[float, float], ...] = ()
) -> tuple[RasterLayout, Float[Array, "y x channel component"]]:
    """A picture in natural colour, or radiance (I, Q, U), DoLP or AoP in some bands.

    Parameters
    ----------
    view
        The traced frame.
    product
        What is wanted. ``rgb`` takes no bands.
    bands_um
        Bands; the sensor's panchromatic one by default. [µm]

    Returns
    -------
    What a file of it holds, and its values; NaN where there are no data. [W m⁻² sr⁻¹ µm⁻¹, 1 or rad]

    Raises
    ------
    ValueError
        If a band is not within the atmosphere's tables or holds none of their wavelengths.
    """
    if product == "rgb":
        values = _natural_colour(view)[:, :, None]
        return _layout(view, values, "rgb", "1", ("",), "colour", ("red", "green", "blue")), values
    bands_um = bands_um or (view.band_um,)
    light = _stokes(view, _band_weights(view.sky, bands_um))
    if product == "radiance":
        values, components, component_dim, units = light, STOKES, "stokes", RADIANCE
    else:
        values = (dolp(light) if product == "dolp" else _masked_aop(light))[..., None].astype(np.float32)
        components, component_dim, units = ("",), "", "1" if product == "dolp" else "rad"
    labels = tuple(f"{a:g}-{b:g} um" for a, b in bands_um)
    layout = _layout(view, values, product, units, labels, component_dim, components, bands_um)
    return layout, values


def cube_layout(view: FrameView, range_um: tuple[float, float] | None = None) -> RasterLayout:
    """What a file of the full spectral cube holds; arguments as `cube_blocks`."""
    wavelength = view.sky.wavelength_um[_chosen(view.sky, range_um)]
    rows, columns = _grid_shape(view)
    channels = len(wavelength)
    if view.grid is None:
        block = (max(BLOCK_BYTES // (12 * columns * channels), 1), channels)
    else:
        larger = max(rows * columns, view.camera.rows * view.camera.columns)
        block = (rows, max(ORTHO_BLOCK_BYTES // (12 * larger), 1))
    return RasterLayout(
        name="radiance",
        units=RADIANCE,
        rows=rows,
        columns=columns,
        channel_dim="wavelength",
        channels=tuple(f"{x:.3f} um" for x in wavelength),
        component_dim="stokes",
        components=STOKES,
        block=block,
        wavelength_um=tuple(wavelength.tolist()),
        width_um=(_TABLE_WIDTH_UM,) * channels,
        stokes_frame=_stokes_frame(view),
        place=_place(view),
        attributes=_facts(view),
    )


def cube_blocks(
    view: FrameView, layout: RasterLayout, range_um: tuple[float, float] | None = None
) -> Iterator[tuple[int, int, Float[Array, "y x channel stokes"]]]:
    """The cube block by block: (first row, first channel, values); `layout.block` of it at a time.

    Parameters
    ----------
    view
        The traced frame.
    layout
        From `cube_layout`.
    range_um
        Wavelengths to take, both ends included; all by default. [µm]

    Notes
    -----
    In camera geometry a block is some rows with all wavelengths; on the ground grid, whose rows draw on the
    whole frame, it is some wavelengths with all rows.
    """
    sky = view.sky
    chosen = _chosen(sky, range_um)
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


def _natural_colour(view: FrameView) -> Float[Array, "y x 3"]:
    sky = view.sky
    weights = colour_channels(sky.wavelength_um)
    if sky.wavelength_um[0] > 0.45 or sky.wavelength_um[-1] < 0.65:
        raise ValueError(
            "`--rgb` must have the atmosphere's tables over 0.45 to 0.65 µm, got "
            f"{sky.wavelength_um[0]:g} to {sky.wavelength_um[-1]:g} µm"
        )
    white = view.observer.white(weights)
    return natural_colour(_stokes(view, weights)[..., 0], white).astype(np.float32)


def _masked_aop(light: Array) -> Array:
    """Angle of polarization; NaN where there is no light to have one."""
    return np.where(light[..., 0] > 0, aop(np.nan_to_num(light)), np.nan)


def _chosen(sky: Sky, range_um: tuple[float, float] | None) -> Array:
    """Which wavelengths of the tables lie in a range, as a mask."""
    table = sky.wavelength_um
    low, high = range_um or (table[0], table[-1])
    if range_um is not None:
        _check_band(sky, range_um)
    return (table >= low - 1e-9) & (table <= high + 1e-9)


def _band_weights(sky: Sky, bands_um: tuple[tuple[float, float], ...]) -> Float[Array, "channel wavelength"]:
    for band in bands_um:
        _check_band(sky, band)
    responses = [Band("band", *band).response(sky.wavelength_um) for band in bands_um]
    return channel_weights(sky.wavelength_um, np.stack(responses))


def _check_band(sky: Sky, band_um: tuple[float, float]) -> None:
    low, high = band_um
    table = sky.wavelength_um
    if not table[0] - 1e-9 <= low < high <= table[-1] + 1e-9:
        raise ValueError(
            f"`--band` must rise within the atmosphere's {table[0]:g} to {table[-1]:g} µm, "
            f"got {low:g}:{high:g} (see atmosphere.wavelength_stop_um)"
        )
    if not ((table >= low - 1e-9) & (table <= high + 1e-9)).any():
        nearest = float(table[np.argmin(np.abs(table - 0.5 * (low + high)))])
        raise ValueError(
            f"`--band` must hold at least one of the atmosphere's wavelengths, got {low:g}:{high:g} "
            f"(the nearest is {nearest:g} µm)"
        )


def _grid_shape(view: FrameView) -> tuple[int, int]:
    if view.grid is None:
        return view.camera.rows, view.camera.columns
    return view.grid.rows, view.grid.columns


def _stokes_frame(view: FrameView) -> str:
    return "detector" if view.grid is None else "meridian"


def _place(view: FrameView) -> GroundPlace | None:
    return None if view.grid is None else view.grid.place


def _facts(view: FrameView) -> tuple[tuple[str, str | float], ...]:
    pose = view.pose
    facts = {"frame": view.frame, "time_s": view.time_s, "lens_east_m": round(pose.east_m, 3)}
    facts |= {"lens_north_m": round(pose.north_m, 3), "lens_up_m": round(pose.up_m, 3)}
    return tuple(facts.items())


def _layout(
    view: FrameView,
    values: Array,
    name: str,
    units: str,
    channels: tuple[str, ...],
    component_dim: str,
    components: tuple[str, ...],
    bands_um: tuple[tuple[float, float], ...] = (),
) -> RasterLayout:
    rows, columns = values.shape[:2]
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
        stokes_frame="" if name in ("rgb", "dolp") else _stokes_frame(view),
        place=_place(view),
        attributes=_facts(view),
    )
