"""Relative permittivity of metals: a conductivity, Lorentz–Drude models, or a user's table of n and k.

Fields are e^(−iωt), so an absorbing medium has Im ε > 0. The models differ a great deal: aluminium of the
paper's conductivity is a far better conductor in the visible than the measured metal. Which one was used is
part of every result.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike
from pydantic import Field, model_validator
from scipy.constants import c, e, epsilon_0, h

from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.io.tables import read_csv

MetalName = Literal["aluminium", "silver", "gold"]
PAPER_ALUMINIUM_S_PER_M = 35.6e6  # Presnar et al. (2010), §3.1
_EV_UM = h * c / e * 1e6  # photon energy [eV] times wavelength [µm]


@dataclass(frozen=True)
class LorentzDrude:
    """Parameters of a Lorentz–Drude model; the first oscillator is the free electrons (frequency 0).

    Parameters
    ----------
    plasma_ev
        Plasma frequency ħω_p. [eV]
    strength, damping_ev, frequency_ev
        Of each oscillator: f [1], ħΓ [eV], ħω [eV].
    range_um
        Wavelengths over which the model was fitted. [µm]
    """

    plasma_ev: float
    strength: tuple[float, ...]
    damping_ev: tuple[float, ...]
    frequency_ev: tuple[float, ...]
    range_um: tuple[float, float]


# Rakić, Djurišić, Elazar and Majewski, Applied Optics 37, 5271 (1998), Tables 1 and 2 (LD model)
LORENTZ_DRUDE: dict[str, LorentzDrude] = {
    "aluminium": LorentzDrude(
        14.98,
        (0.523, 0.227, 0.050, 0.166, 0.030),
        (0.047, 0.333, 0.312, 1.351, 3.382),
        (0.0, 0.162, 1.544, 1.808, 3.473),
        (0.062, 248.0),  # 0.005 to 20 eV
    ),
    "silver": LorentzDrude(
        9.01,
        (0.845, 0.065, 0.124, 0.011, 0.840, 5.646),
        (0.048, 3.886, 0.452, 0.065, 0.916, 2.419),
        (0.0, 0.816, 4.481, 8.185, 9.083, 20.29),
        (0.207, 12.4),  # 0.1 to 6 eV
    ),
    "gold": LorentzDrude(
        9.03,
        (0.760, 0.024, 0.010, 0.071, 0.601, 4.384),
        (0.053, 0.241, 0.345, 0.870, 2.494, 2.214),
        (0.0, 0.415, 0.830, 2.969, 4.304, 13.32),
        (0.207, 12.4),  # 0.1 to 6 eV
    ),
}


class MetalDesign(Design):
    """A metal and how its optical constants are known; the ``[metal]`` table of a device's design."""

    model: Literal["conductivity", "lorentz-drude", "table"] = Field(
        default="conductivity",
        description="`conductivity` (ε = 1 + iσ/(ωε₀)), `lorentz-drude` (Rakić 1998), `table` (CSV of n, k)",
    )
    name: MetalName = Field(default="aluminium", description="Which metal, for `lorentz-drude`")
    conductivity_s_per_m: float = Field(
        default=PAPER_ALUMINIUM_S_PER_M, ge=0, le=1e9, description="σ, for `conductivity`"
    )
    table: Path | None = Field(
        default=None,
        description="CSV with columns wavelength_um, n, k (n + ik), for `table`; from where the design lies",
    )

    @model_validator(mode="after")
    def _a_table_has_a_file(self) -> Self:
        if (self.model == "table") != (self.table is not None):
            came = "none" if self.table is None else str(self.table)
            raise ValueError(
                f"`metal.table` must name a CSV file if and only if `metal.model` is 'table', got {came}"
            )
        return self

    def located(self, folder: Path) -> Self:
        """The same metal with its file name meant from ``folder``."""
        return self if self.table is None else self.model_copy(update={"table": folder / self.table})


def permittivity(metal: MetalDesign, wavelength_um: ArrayLike) -> Complex[Array, "..."]:
    """Relative permittivity of a metal by the model its design names.

    Parameters
    ----------
    metal
        The design.
    wavelength_um
        Vacuum wavelengths. [µm]

    Returns
    -------
    Im ε ≥ 0. [1]

    Raises
    ------
    ValueError
        If a wavelength lies outside the model's range or the table's.
    """
    if metal.model == "conductivity":
        return conductor_permittivity(wavelength_um, metal.conductivity_s_per_m)
    if metal.table is not None:
        return read_nk(metal.table).permittivity(wavelength_um)
    return lorentz_drude_permittivity(wavelength_um, metal.name)


def conductor_permittivity(
    wavelength_um: ArrayLike, conductivity_s_per_m: float = PAPER_ALUMINIUM_S_PER_M
) -> Complex[Array, "..."]:
    """ε = 1 + iσ/(ωε₀): free charges without inertia, the paper's aluminium. [1]

    Parameters
    ----------
    wavelength_um
        Vacuum wavelengths. [µm]
    conductivity_s_per_m
        Direct-current conductivity σ. [S m⁻¹]

    References
    ----------
    Presnar et al., Proc. SPIE 7672, 76720T (2010), §3.1.
    """
    omega = 2 * math.pi * c / (np.asarray(wavelength_um, dtype=float) * 1e-6)
    return 1 + 1j * conductivity_s_per_m / (omega * epsilon_0)


def lorentz_drude_permittivity(
    wavelength_um: ArrayLike, metal: MetalName = "aluminium"
) -> Complex[Array, "..."]:
    """Lorentz–Drude permittivity of evaporated aluminium, silver or gold. [1]

    Parameters
    ----------
    wavelength_um
        Vacuum wavelengths within the fit's range. [µm]
    metal
        ``"aluminium"``, ``"silver"`` or ``"gold"``.

    References
    ----------
    Rakić, Djurišić, Elazar and Majewski, Applied Optics 37, 5271 (1998), Eqs. (1)–(4) and Tables 1–2.
    """
    if metal not in LORENTZ_DRUDE:
        raise ValueError(f"`metal` must be one of {', '.join(LORENTZ_DRUDE)}, got {metal!r}")
    model = LORENTZ_DRUDE[metal]
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    _check_range(wavelength_um, model.range_um, f"the Lorentz–Drude model of {metal}")
    energy = _EV_UM / wavelength_um
    terms = zip(model.strength, model.damping_ev, model.frequency_ev, strict=True)
    # a free electron is an oscillator of frequency 0
    eps = np.ones(energy.shape, dtype=complex)
    for strength, damping, frequency in terms:
        eps = eps + strength * model.plasma_ev**2 / (frequency**2 - energy**2 - 1j * energy * damping)
    return eps


@dataclass(frozen=True)
class NkTable:
    """Tabulated complex refractive index n + ik.

    Parameters
    ----------
    wavelength_um
        Rising. [µm]
    n, k
        Refractive index and extinction coefficient. [1]
    name
        What to call it in an error.
    """

    wavelength_um: Float[Array, "row"]
    n: Float[Array, "row"]
    k: Float[Array, "row"]
    name: str

    def permittivity(self, wavelength_um: ArrayLike) -> Complex[Array, "..."]:
        """(n + ik)², n and k interpolated linearly; outside the table is an error. [1]"""
        wavelength_um = np.asarray(wavelength_um, dtype=float)
        _check_range(wavelength_um, (self.wavelength_um[0], self.wavelength_um[-1]), self.name)
        n = np.interp(wavelength_um, self.wavelength_um, self.n)
        return (n + 1j * np.interp(wavelength_um, self.wavelength_um, self.k)) ** 2


_LARGEST = 1e4  # wavelength in µm, n, k: aluminium reaches 200 at 30 µm


def read_nk(path: str | Path) -> NkTable:
    """Read a CSV with columns ``wavelength_um``, ``n`` and ``k``; lines that start with ``#`` are a header.

    Raises
    ------
    ValueError
        If the file cannot be read, a column is missing, a cell is not a number, wavelengths do not rise, or
        n or k is negative or beyond any metal's.
    """
    path = Path(path)
    table = read_csv(path, "metal.table", types=str)
    columns = {}
    for column in ("wavelength_um", "n", "k"):
        try:
            columns[column] = np.array([float(value) for value in table[column]])
        except (KeyError, ValueError) as error:
            raise ValueError(
                f"`metal.table` must have a number in column {column!r} of every row, got {path} with {error}"
            ) from error
        if not ((columns[column] >= 0) & (columns[column] <= _LARGEST)).all():
            raise ValueError(
                f"`metal.table` must have {column} of 0 to {_LARGEST:g} (n + ik), got others in {path}"
            )
    if len(table) < 2 or (np.diff(columns["wavelength_um"]) <= 0).any():
        raise ValueError(f"`metal.table` must hold two or more rising wavelengths, got {path}")
    return NkTable(columns["wavelength_um"], columns["n"], columns["k"], path.name)


def _check_range(wavelength_um: Array, limits_um: tuple[float, float], what: str) -> None:
    outside = (wavelength_um < limits_um[0] - 1e-9) | (wavelength_um > limits_um[1] + 1e-9)
    if outside.any():
        raise ValueError(
            f"`wavelength_um` must lie within {limits_um[0]:g} to {limits_um[1]:g} µm, where {what} holds, "
            f"got {wavelength_um[outside].flat[0]:g}"
        )
