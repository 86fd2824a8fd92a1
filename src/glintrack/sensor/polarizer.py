"""Polarizers over the elements: Mueller matrices over wavelength, and the row of them an element sees.

An element counts photons of any polarization, so that of a polarizer's Mueller matrix only the first
row reaches a frame: light S makes row · S, Eqs. (8)–(9). A polarizer turned by θ has the row of its own axes
times the rotation R(θ).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array
from glintrack.core.spectral import MAX_WAVELENGTH_UM, MIN_WAVELENGTH_UM, resample
from glintrack.devices import PAPER_GRIDS, wire_grid
from glintrack.io.netcdf import read_dataset
from glintrack.io.untrusted import is_file
from glintrack.sensor.design import SensorDesign
from glintrack.stokes import linear_diattenuator, rotation_mueller

APERTURE_SHARE = 10 / 15  # of the 15 µm port that the paper's Eq. (7) refers to: the aperture's width
LARGEST_TRANSMITTANCE = 1.5  # a narrow aperture gathers some light from beside it, not this much
_PRINCIPAL = ("pass_transmittance", "block_transmittance")
_RANGE_UM = np.array([MIN_WAVELENGTH_UM, MAX_WAVELENGTH_UM])


@dataclass(frozen=True)
class Polarizer:
    """A polarizer over an element, per light that falls on its aperture.

    Parameters
    ----------
    wavelength_um
        Rising. [µm]
    mueller
        Mueller matrices about the polarizer's own pass axis, at each angle of incidence. Transmittance above
        1 is possible: a slit of a few wavelengths gathers light from beside it. [1]
    incidence_rad
        Rising from the first one tabulated; one angle holds at all. [rad]
    """

    wavelength_um: Float[Array, "wavelength"]
    mueller: Float[Array, "incidence wavelength 4 4"]
    incidence_rad: Float[Array, "incidence"] = field(default_factory=lambda: np.zeros(1))

    def matrix(
        self, wavelength_um: Float[Array, "band"], incidence_rad: float = 0.0
    ) -> Float[Array, "band 4 4"]:
        """Mueller matrix about the pass axis, linear between what is tabulated. [1]

        Raises
        ------
        ValueError
            If a wavelength lies outside the table.
        """
        values = np.moveaxis(self.mueller, 1, -1)  # wavelength last
        columns = values.reshape(len(values), -1).T
        at_angle = np.array([np.interp(incidence_rad, self.incidence_rad, column) for column in columns])
        at_angle = at_angle.reshape(values.shape[1:])
        return np.moveaxis(resample(wavelength_um, self.wavelength_um, at_angle, "sensor.polarizer"), -1, 0)

    def analyser_row(
        self, wavelength_um: Float[Array, "band"], angle_rad: float, incidence_rad: float = 0.0
    ) -> Float[Array, "band 4"]:
        """First row of the Mueller matrix with the pass axis at an angle from the light's reference axis.

        Parameters
        ----------
        wavelength_um
            Where to evaluate. [µm]
        angle_rad
            Pass axis as the light sees it, counter-clockwise looking at the source; of light that comes
            slantwise from `axis_at_incidence`. [rad]
        incidence_rad
            Angle of incidence. [rad]

        Returns
        -------
        What an element reads of I, Q, U and V over the light on it. [1]
        """
        return self.matrix(wavelength_um, incidence_rad)[:, 0] @ rotation_mueller(angle_rad)


def axis_at_incidence(angle_rad: ArrayLike, incidence_rad: ArrayLike, azimuth_rad: ArrayLike) -> Array:
    """Pass axis of a tilted polarizer, from the detector's +x, both projected transverse to the ray. [rad]

    What is absorbed or reflected is the field along the projected wires (or dichroic molecules); the pass
    axis is at right angles to that.

    Parameters
    ----------
    angle_rad
        Pass axis in the detector's plane, from +x. [rad]
    incidence_rad, azimuth_rad
        Angle of incidence, and direction of the plane of incidence in the detector's plane from +x. [rad]

    References
    ----------
    Korger et al., "The polarization properties of a tilted polarizer", Optics Express 21, 27032 (2013).
    """
    shortened = np.cos(incidence_rad)

    def project(angle: Array) -> Array:
        from_plane = angle - azimuth_rad
        return np.arctan2(np.sin(from_plane), np.cos(from_plane) * shortened)

    wires = project(np.asarray(angle_rad, dtype=float) + np.pi / 2)
    return wires - np.pi / 2 - project(np.zeros(()))


def from_transmittances(
    wavelength_um: Float[Array, "wavelength"],
    pass_transmittance: Float[Array, "wavelength"],
    block_transmittance: Float[Array, "wavelength"],
    retardance_rad: float | Float[Array, "wavelength"] = 0.0,
) -> Polarizer:
    """Linear diattenuator, Eqs. (8)–(9), from irradiance transmittances and retardance over wavelength."""
    columns = np.broadcast_arrays(pass_transmittance, block_transmittance, retardance_rad)
    matrices = []
    for passed, blocked, retardance in zip(*(c.tolist() for c in columns), strict=True):
        scale = max(1.0, passed, blocked)  # light from beside the aperture
        matrices.append(scale * linear_diattenuator(passed / scale, blocked / scale, 0.0, retardance))
    return Polarizer(np.asarray(wavelength_um, dtype=float), np.array(matrices)[None])


def from_table(table: xr.Dataset, name: str = "the table") -> Polarizer:
    """Polarizer of a table over ``wavelength``: whole Mueller matrices, or principal transmittances.

    Parameters
    ----------
    table
        ``mueller_per_aperture`` (wavelength, stokes_out, stokes_in), perhaps over ``incidence`` [rad] too;
        else ``pass_transmittance_per_aperture`` and ``block_transmittance_per_aperture``; else the same
        without ``_per_aperture`` in the normalisation of Eq. (7).
    name
        What to call it in errors.

    Raises
    ------
    ValueError
        If the table holds none of these, or what no polarizer has.
    """
    _check_axis(table, "wavelength", MAX_WAVELENGTH_UM * 10, name)
    if "mueller_per_aperture" in table:
        return _of_matrices(table, name)
    columns = []
    for column in _PRINCIPAL:
        share = 1.0 if f"{column}_per_aperture" in table else APERTURE_SHARE
        source = f"{column}_per_aperture" if share == 1 else column
        if source not in table or table[source].dims != ("wavelength",):
            raise ValueError(
                f"`sensor.polarizer` must hold mueller_per_aperture, or {column} over wavelength; got "
                f"{sorted(map(str, table))} in {name}."
            )
        values = np.asarray(table[source].values, dtype=float)
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= LARGEST_TRANSMITTANCE):
            raise ValueError(
                f"`sensor.polarizer` must have {source} within 0 to {LARGEST_TRANSMITTANCE:g}; "
                f"got others in {name}."
            )
        columns.append(values / share)
    return from_transmittances(table["wavelength"].values.astype(float), *columns)


def _check_axis(table: xr.Dataset, axis: str, largest: float, name: str) -> None:
    """Refuse a coordinate that is missing, not of finite numbers, or does not rise."""
    values = table[axis].values if axis in table.coords else np.empty(0)
    if values.dtype.kind not in "fiu" or values.size < 1:
        raise ValueError(f"`sensor.polarizer` must have a coordinate {axis} of numbers; got none in {name}.")
    if not ((values >= 0) & (values <= largest)).all() or (np.diff(values.astype(float)) <= 0).any():
        raise ValueError(
            f"`sensor.polarizer` must have {axis} rising within 0 to {largest:.3g}; got others in {name}."
        )


def _of_matrices(table: xr.Dataset, name: str) -> Polarizer:
    source = table["mueller_per_aperture"]
    slanted = "incidence" in source.dims
    if slanted:
        _check_axis(table, "incidence", np.pi / 2, name)
    order = (*(("incidence",) if slanted else ()), "wavelength", "stokes_out", "stokes_in")
    if set(source.dims) != set(order) or (source.sizes["stokes_out"], source.sizes["stokes_in"]) != (4, 4):
        raise ValueError(
            "`sensor.polarizer` must have mueller_per_aperture of 4 × 4 over wavelength (and incidence); got "
            f"{dict(source.sizes)} in {name}."
        )
    matrices = np.asarray(source.transpose(*order).values, dtype=float)
    matrices = matrices if slanted else matrices[None]
    row = matrices[..., 0, :]
    if not np.isfinite(matrices).all() or row[..., 0].max() > LARGEST_TRANSMITTANCE:
        raise ValueError(
            f"`sensor.polarizer` must transmit 0 to {LARGEST_TRANSMITTANCE:g} of light; got others in {name}."
        )
    if (np.linalg.norm(row[..., 1:], axis=-1) > row[..., 0] * (1 + 1e-9) + 1e-12).any():
        raise ValueError(
            "`sensor.polarizer` must pass no less than nothing of any light; got a first row of "
            f"mueller_per_aperture whose polarized part exceeds its first element in {name}."
        )
    angles = table["incidence"].values.astype(float) if slanted else np.zeros(1)
    return Polarizer(table["wavelength"].values.astype(float), matrices, angles)


def _constant(design: SensorDesign) -> Polarizer:
    """One transmittance and extinction ratio at all wavelengths."""
    passed = np.full(2, design.polarizer_transmittance)
    return from_transmittances(_RANGE_UM, passed, passed / design.polarizer_extinction_ratio)


def _from_solver(design: SensorDesign) -> Polarizer:
    """One of the paper's wire grids, from its solved table."""
    return from_table(wire_grid.load(design.polarizer), design.polarizer)


MODELS: dict[str, Callable[[SensorDesign], Polarizer]] = {
    "ideal": lambda _: from_transmittances(_RANGE_UM, np.ones(2), np.zeros(2)),  # half of unpolarized light
    "constant": _constant,
    **dict.fromkeys(PAPER_GRIDS, _from_solver),
}


def load_polarizer(design: SensorDesign) -> Polarizer:
    """Load the polarizer of a design: one of `MODELS`, or a NetCDF file for `from_table`.

    Raises
    ------
    ValueError
        If a file cannot be read or holds no polarizer.
    """
    name = design.polarizer
    if name in MODELS:
        return MODELS[name](design)
    if not is_file(Path(name)):
        raise ValueError(f"`sensor.polarizer` must be {', '.join(MODELS)} or a NetCDF file; got {name!r}.")
    return from_table(read_dataset(Path(name), "sensor.polarizer"), name)
