"""Relative permittivity of metals: a conductivity, Lorentz–Drude models, or a user's table of n and k.

Fields are e^(−iωt), so an absorbing medium has Im ε > 0. The models differ a great deal: aluminium of the
paper's conductivity is a far better conductor in the visible than the measured metal. Every result names its
model.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np
from jaxtyping import Complex
from numpy.typing import ArrayLike
from pydantic import Field, model_validator
from scipy.constants import c, e, epsilon_0, h

from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.core.installation import read_data
from glintrack.io.spectra import read_spectra

MetalName = Literal["aluminium", "silver", "gold"]
PAPER_ALUMINIUM_S_PER_M = 35.6e6  # Presnar et al. (2010), §3.1
_MAX_INDEX = 1e4  # of n and k: aluminium reaches 200 at 30 µm
_EV_UM = h * c / e * 1e6  # photon energy [eV] times wavelength [µm]


@dataclass(frozen=True)
class LorentzDrude:
    """Plasma frequency ħω_p [eV], f [1], ħΓ [eV] and ħω [eV] of each oscillator, and range of the fit [µm].

    The first oscillator is the free electrons (frequency 0).
    """

    plasma_ev: float
    strength: tuple[float, ...]
    damping_ev: tuple[float, ...]
    frequency_ev: tuple[float, ...]
    range_um: tuple[float, float]


class MetalDesign(Design):
    """A metal and how its optical constants are known; the ``[metal]`` table of a device's design."""

    model: Literal["conductivity", "lorentz-drude", "table"] = "conductivity"
    """`conductivity` (ε = 1 + iσ/(ωε₀)), `lorentz-drude` (Rakić 1998), `table` (CSV of n, k)."""
    name: MetalName = Field(default="aluminium", description="Which metal, for `lorentz-drude`")
    conductivity_s_per_m: float = Field(default=PAPER_ALUMINIUM_S_PER_M, ge=0, le=1e9)
    """σ, for `conductivity`."""
    table: Path | None = None
    """CSV with columns wavelength_um, n, k (n + ik), for `table`; relative to the design's folder."""

    @model_validator(mode="after")
    def _a_table_has_a_file(self) -> Self:
        if (self.model == "table") != (self.table is not None):
            came = "none" if self.table is None else str(self.table)
            raise ValueError(
                f"`metal.table` must name a CSV file if and only if `metal.model` is 'table'; got {came}."
            )
        return self

    def resolve_files(self, folder: Path) -> Self:
        """Resolve the metal's file name against ``folder``."""
        return self if self.table is None else self.model_copy(update={"table": folder / self.table})


def permittivity(metal: MetalDesign, wavelength_um: ArrayLike) -> Complex[Array, "..."]:
    """Relative permittivity of a metal by the model of its design.

    Parameters
    ----------
    metal
        The design. `conductivity` is ε = 1 + iσ/(ωε₀): free charges without inertia, the paper's aluminium.
    wavelength_um
        Vacuum wavelengths. [µm]

    Returns
    -------
    Im ε ≥ 0. [1]

    Raises
    ------
    ValueError
        If a wavelength lies outside the model's range or the table's.

    References
    ----------
    Presnar et al., Proc. SPIE 7672, 76720T (2010), §3.1.
    Rakić, Djurišić, Elazar and Majewski, Applied Optics 37, 5271 (1998), Eqs. (1)–(4) and Tables 1–2.
    """
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    if metal.model == "conductivity":
        omega = 2 * math.pi * c / (wavelength_um * 1e-6)
        return 1 + 1j * metal.conductivity_s_per_m / (omega * epsilon_0)
    if metal.table is not None:
        table = read_spectra(metal.table, "metal.table", dict.fromkeys("nk", (0.0, _MAX_INDEX)))
        table_um = table["wavelength_um"]
        _check_range(wavelength_um, (table_um[0], table_um[-1]), metal.table.name)
        n, k = (np.interp(wavelength_um, table_um, table[name]) for name in ("n", "k"))
        return (n + 1j * k) ** 2
    model = LorentzDrude(**read_data("devices", "lorentz_drude.toml")[metal.name])
    _check_range(wavelength_um, model.range_um, f"the Lorentz–Drude model of {metal.name}")
    energy = _EV_UM / wavelength_um
    eps = np.ones(energy.shape, dtype=complex)
    for strength, damping, frequency in zip(
        model.strength, model.damping_ev, model.frequency_ev, strict=True
    ):
        eps = eps + strength * model.plasma_ev**2 / (frequency**2 - energy**2 - 1j * energy * damping)
    return eps


def _check_range(wavelength_um: Array, limits_um: tuple[float, float], what: str) -> None:
    outside = (wavelength_um < limits_um[0] - 1e-9) | (wavelength_um > limits_um[1] + 1e-9)
    if outside.any():
        raise ValueError(
            f"`wavelength_um` must lie within {limits_um[0]:g} to {limits_um[1]:g} µm, where {what} holds; "
            f"got {wavelength_um[outside].flat[0]:g}."
        )
