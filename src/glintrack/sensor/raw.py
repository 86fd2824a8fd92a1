"""Stokes vectors from the raw mosaic of a polarization camera: black level, gain, calibration, demosaicking.

An element's count c is its dark count d plus the product of its analyser row w and the light on it,
c = d + w · S. Without a calibration all elements under polarizers have one gain and the ideal row of their
angle, and open ones twice the gain. With a calibration, each superpixel's vector Ŝ by least squares over its
own rows converts every element to its ideal row a: r = (c − d − w · Ŝ)/w₀ + a · Ŝ. That is exact where light
is even over a superpixel, and correct to first order elsewhere, so that any demosaicking can follow.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import xarray as xr
from jaxtyping import Float, UInt
from pydantic import Field, model_validator

from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.core.schema import COUNT, RADIANCE, check
from glintrack.io.netcdf import read_dataset
from glintrack.io.raw_mosaics import read_raw
from glintrack.sensor import layouts
from glintrack.sensor.demosaicking import demosaic
from glintrack.sensor.design import Angle
from glintrack.sensor.exposure import NOISE_FLOORS, label_frame
from glintrack.stokes import aop, dolp

_SINGULAR = 1e-5  # determinant over the cube of the mean eigenvalue, of rows that do not determine a vector


class RawDesign(Design):
    """Layout, levels and gain of a raw mosaic, and its demosaicking."""

    layout: str | tuple[tuple[Angle | str, ...], ...] = "0-45-90-135"
    """Superpixel: one of `layouts.LAYOUTS`, or rows of ``open``, ``mirror`` and angles [deg]."""
    demosaic: layouts.Demosaicker = "bilinear"
    """Interpolation of the elements of a superpixel to one place."""
    black_level: float = Field(default=0.0, ge=0, le=65535)
    """Count without light, where no calibration gives it for each element."""
    white_level: float | None = Field(default=None, gt=0, le=65535)
    """Count of a full element; the highest of the bits that the frame fills if left out."""
    gain: float | None = Field(default=None, gt=0, le=1e9)
    """W m⁻² sr⁻¹ µm⁻¹ of unpolarized light per count under a polarizer; by default counts."""
    dark_noise: float = Field(default=1.0, ge=0, le=65535)
    """RMS of an element in the dark, in counts: DoLP is NaN where S0 is within three times its own."""
    max_saturated: float = Field(default=0.05, ge=0, le=1)
    """Share of full elements above which a frame is refused; up to it superpixels that use one are NaN."""

    @model_validator(mode="after")
    def _white_above_black(self) -> Self:
        if self.white_level is not None and self.white_level <= self.black_level:
            raise ValueError(
                f"`white_level` must be above black_level, {self.black_level:g} counts; got "
                f"{self.white_level:g}."
            )
        return self


@dataclass(frozen=True)
class Analysers:
    """A calibration of a camera, element by element.

    Parameters
    ----------
    row
        Response of each element to I, Q and U; NaN for one that is not to be used. [count per unit of light]
    dark
        Count of each element without light; None for the design's black level. [count]
    """

    row: Float[Array, "row column 3"]
    dark: Float[Array, "row column"] | None = None


def read_analysers(path: str | Path) -> Analysers:
    """Read a calibration from NetCDF-4: ``analyser`` (y, x, stokes), and ``dark`` (y, x) if it was measured.

    Raises
    ------
    ValueError
        If the file is missing or invalid, or an element has a negative response to some light.
    """
    table = read_dataset(Path(path), "calibration")
    if "analyser" not in table or table["analyser"].dims != ("y", "x", "stokes"):
        raise ValueError(
            "`calibration` must hold analyser over y, x, stokes; got "
            f"{ {str(n): v.dims for n, v in table.data_vars.items()} } in {path}."
        )
    columns = {}
    for name in {"analyser", "dark"} & set(table):
        if table[name].dtype.kind not in "fiu":
            raise ValueError(f"`calibration` must hold numbers; got {table[name].dtype} in {path}.")
        columns[name] = table[name].values.astype(np.float64)
    row, dark = columns["analyser"], columns.get("dark")
    if row.shape[-1] != 3 or row.size == 0:
        raise ValueError(f"`calibration` must give I, Q and U of each element; got {row.shape} in {path}.")
    polarized = np.hypot(row[..., 1], row[..., 2])
    if np.isinf(row).any() or (row[..., 0] <= 0).any() or (polarized > 1.5 * row[..., 0]).any():
        raise ValueError(
            "`calibration` must have rows, or NaN, whose I is positive and not under two thirds of what is "
            f"polarized; got others in {path}."
        )
    if dark is not None and (dark.shape != row.shape[:2] or not (np.abs(dark) <= 65535).all()):
        raise ValueError(
            f"`calibration` must have dark counts within ±65535 of all elements; got others in {path}."
        )
    return Analysers(row, dark)


def measure_polarization(
    raw: str | Path | UInt[Array, "row column"],
    design: RawDesign | None = None,
    calibration: Analysers | None = None,
    time_s: float = 0.0,
    name: str | Path | None = None,
) -> xr.Dataset:
    """Compute Stokes vectors, DoLP and AoP of a raw mosaic, as ``glintrack polarimetry`` does.

    Parameters
    ----------
    raw
        A file, or its counts, 8 or 16 bits without sign.
    design
        Layout and levels; `RawDesign` of a Polarsens camera by default.
    calibration
        Calibration of the camera, from `read_analysers`.
    name
        Name of the mosaic in errors; by default its file.

    Returns
    -------
    Schema ``frame``, with ``dolp`` [1] and ``aop`` [rad] in the detector's axes; NaN where an element that
    is needed is full or not to be used. S0 is the reading of an element under a polarizer in unpolarized
    light: the mean of a superpixel's polarizers, which is half of I0 + I90.

    Raises
    ------
    ValueError
        If the mosaic holds no whole superpixels or is saturated, or the calibration is of another size.
    """
    design = RawDesign() if design is None else design
    name = str(name or ("the array" if isinstance(raw, np.ndarray) else raw))
    counts = raw if isinstance(raw, np.ndarray) else read_raw(raw)
    layout = layouts.superpixel(design.layout, "layout")
    layouts.check_demosaicker(design.demosaic, layout, "demosaic")
    inverse = layouts.invert(layouts.analyser_matrix(layout, 1.0), "layout")
    full = _find_full(counts, layout, design, name)
    readings = _ideal_readings(counts, layout, design, calibration, name)
    readings[full] = np.nan
    gain = design.gain or 1.0
    stokes = demosaic(readings, layout, design.demosaic) @ inverse.T.astype(np.float32) * np.float32(gain)
    noise = float(np.hypot.reduce(inverse[0])) * design.dark_noise * gain
    if calibration is not None:  # its rows are counts per unit of light
        noise /= float(np.nanmedian(np.abs(calibration.row[..., 0])))
    about = {
        "time_s": float(time_s),
        "dolp_floor": NOISE_FLOORS * noise,
        "saturated_share": float(full.mean()),
    }
    pan = stokes[..., 0]
    place = layouts.pan_element(layout)
    if place is not None:
        pan = readings[place[0] :: len(layout), place[1] :: len(layout)] * np.float32(gain)
    units = COUNT if design.gain is None else RADIANCE
    frame = check(label_frame(pan, stokes, layout, design.demosaic, about, units), "frame")
    degree = dolp(stokes, about["dolp_floor"]).astype(np.float32)
    angle = np.where(np.isfinite(degree), aop(stokes), np.nan).astype(np.float32)
    return frame.assign(
        dolp=(("y", "x"), degree, {"units": "1"}),
        aop=(("y", "x"), angle, {"units": "rad", "stokes_frame": "detector"}),
    )


def white_level(counts: UInt[Array, "row column"]) -> int:
    """Count of a full element, from the bits that a frame uses. [count]

    The frame has the fewest of 8, 10, 12, 14 and 16 bits that hold its counts. Low bits that are 0 in every
    count are below the quantizer's (12 bits in the upper part of 16).
    """
    every = int(np.bitwise_or.reduce(counts, axis=None))
    if every == 0:
        return (1 << 8 * counts.dtype.itemsize) - 1
    below = (every & -every).bit_length() - 1
    return next(1 << bits for bits in (8, 10, 12, 14, 16) if every < 1 << bits) - (1 << below)


def _find_full(counts: Array, layout: layouts.Superpixel, design: RawDesign, name: str) -> Array:
    """Mask of full elements; refuse a frame without whole superpixels, or with too many full elements."""
    side = len(layout)
    for axis, what in enumerate(("rows", "columns")):
        if counts.shape[axis] % side or counts.shape[axis] < 2 * side:
            number = "even" if side == 2 else f"a multiple of {side}"
            raise ValueError(
                f"`RAW` must have {number} {what}, {2 * side} at least ({side} × {side} superpixels); got "
                f"{counts.shape[axis]} in {name}. Crop it so that its first element is a superpixel's first."
            )
    white = white_level(counts) if design.white_level is None else design.white_level
    if white <= design.black_level:
        raise ValueError(
            f"`black_level` must be below that of a full element, {white:g} counts; got "
            f"{design.black_level:g} for {name}."
        )
    full = counts >= white
    share = float(full.mean())
    if share > design.max_saturated:
        raise ValueError(
            f"`RAW` must have at most {100 * design.max_saturated:g} % of its elements full, at "
            f"{white:g} counts; got {100 * share:.3g} % in {name}. Expose for less time, or allow more."
        )
    return full


def _ideal_readings(
    counts: Array, layout: layouts.Superpixel, design: RawDesign, calibration: Analysers | None, name: str
) -> Float[Array, "row column"]:
    """Convert counts to readings behind ideal analysers, unpolarized light as S0. [count]"""
    tiles = tuple(n // len(layout) for n in counts.shape)
    if calibration is None:
        part = np.array([[0.5 if isinstance(what, str) else 1.0 for what in row] for row in layout])
        return (np.tile(part, tiles) * (counts.astype(np.float64) - design.black_level)).astype(np.float32)
    if calibration.row.shape[:2] != counts.shape:
        of = " × ".join(map(str, calibration.row.shape[:2]))
        raise ValueError(
            f"`calibration` must be of the raw's {counts.shape[0]} × {counts.shape[1]} elements; got {of} "
            f"for {name}."
        )
    dark = design.black_level if calibration.dark is None else calibration.dark
    light = counts.astype(np.float64) - dark
    vector = _superpixel_vectors(light, calibration.row, len(layout))
    ideal = np.zeros((len(layout), len(layout), 3))
    ideal[..., 0] = 1
    for place, row in zip(
        layouts.places(layout, "polarizer"), layouts.analyser_matrix(layout, 1.0), strict=True
    ):
        ideal[place] = row
    local = np.repeat(np.repeat(vector, len(layout), axis=0), len(layout), axis=1)
    own = light - np.einsum("yxs,yxs->yx", calibration.row, local)
    seen = own / calibration.row[..., 0] + np.einsum("yxs,yxs->yx", np.tile(ideal, (*tiles, 1)), local)
    return seen.astype(np.float32)


def _superpixel_vectors(light: Array, row: Array, side: int) -> Float[Array, "y x 3"]:
    """Least-squares Stokes vector of each superpixel over its own analyser rows; NaN where one is NaN."""
    shape = (light.shape[0] // side, light.shape[1] // side)

    def by_superpixel(values: Array) -> Array:
        parts = values.reshape(shape[0], side, shape[1], side, -1).swapaxes(1, 2)
        return parts.reshape(*shape, side * side, -1)

    rows, seen = by_superpixel(row), by_superpixel(light)
    known = np.isfinite(rows.sum(axis=(2, 3)))
    safe = np.where(known[..., None, None], rows, np.eye(side * side, 3))
    normal = np.einsum("yxks,yxkt->yxst", safe, safe)
    trace = np.trace(normal, axis1=2, axis2=3)
    poor = np.linalg.det(normal) < _SINGULAR * (trace / 3) ** 3
    if poor.any():
        y, x = np.argwhere(poor)[0]
        raise ValueError(
            f"`calibration` must have rows that determine S0, S1 and S2 in every superpixel; got others in "
            f"that of row {side * y}, column {side * x}. Set elements that are not used to NaN."
        )
    right = np.einsum("yxks,yxk->yxs", safe, seen[..., 0])
    found = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.where(known[..., None], found, np.nan)
