"""Wire-grid polarizers: solved tables, and the quantities of Eqs. (7)–(9) that follow from them.

A table is a Dataset over ``wavelength``. `load` gives the shipped ones, `solve` makes new ones. Angles ψ of
the light's polarization are from the axis *across* the wires, the pass axis.
"""

import json
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from glintrack import stokes
from glintrack.core import spectral
from glintrack.core.arrays import Array
from glintrack.devices.optical_constants import permittivity
from glintrack.devices.wire_grid.design import PAPER_GRIDS, WireGridDesign
from glintrack.devices.wire_grid.sweep import has_solver, require_solver, sweep

ANGLES_DEG = tuple(range(0, 100, 10))  # ψ of the paper's Figure 6
SOLVED = {
    "pass_transmittance": "T(λ, 0°) of Eq. (7): power behind over the same with grid and plate removed",
    "block_transmittance": "T(λ, 90°) of Eq. (7)",
    "pass_reflectance": "share of the incident power reflected, E across the wires",
    "block_reflectance": "share of the incident power reflected, E along the wires",
    "pass_absorptance": "share of the incident power absorbed in the wires, E across them",
    "block_absorptance": "share of the incident power absorbed in the wires, E along them",
    "free_transmittance": "share of the incident power that crosses the space with grid and plate removed",
    "field_ratio_real": "Re of the pass over the block amplitude of the wave that leaves straight on",
    "field_ratio_imag": "Im of the same",
    "coherence_real": "Re of the power of interference of both polarizations over the removed run's power",
    "coherence_imag": "Im of the same",
}


def load(name: str) -> xr.Dataset:
    """Shipped table of one of the paper's grids, 211 wavelengths.

    Parameters
    ----------
    name
        ``"grid_a"`` or ``"grid_b"`` (the paper's conductor), ``"grid_a_physical"`` or ``"grid_b_physical"``
        (aluminium by Lorentz–Drude, Rakić 1998).

    Returns
    -------
    See `complete`.
    """
    if name not in PAPER_GRIDS:
        raise ValueError(f"`name` must be one of {', '.join(PAPER_GRIDS)}, got {name!r}")
    if not _shipped(name).is_file():
        raise ValueError(
            f"`name` must be a table of this installation, got {name!r} without one "
            f"(python tools/make_wiregrid_tables.py {name})"
        )
    with as_file(_shipped(name)) as path:
        return complete(xr.load_dataset(path, engine="h5netcdf"))


def response(
    design: WireGridDesign, wavelength_um: ArrayLike, progress: Callable[[float], None] | None = None
) -> xr.Dataset:
    """Table of a design: shipped if it is one of the paper's and the wavelengths are in it, else solved."""
    um = spectral.check_wavelengths(wavelength_um)
    for name, known in PAPER_GRIDS.items():
        if design == known and _shipped(name).is_file():
            table = load(name)
            nearest = np.abs(table["wavelength"].values[:, None] - um).argmin(axis=0)
            if np.allclose(table["wavelength"].values[nearest], um, rtol=0, atol=1e-9):
                return table.isel(wavelength=nearest)
    return solve(design, um, progress=progress)


def _shipped(name: str) -> Traversable:
    return files("glintrack") / "data" / "devices" / f"{name}.nc"


def solve(
    design: WireGridDesign,
    wavelength_um: ArrayLike,
    *,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
    cache: Path | None = None,
) -> xr.Dataset:
    """Solve Maxwell's equations for a grid; needs the extra ``em``.

    Parameters
    ----------
    design
        The grid.
    wavelength_um
        Rising, within 0.4 to 2.5 µm and the metal's data. [µm]
    workers
        Processes; all cores by default. Each takes about 0.4 GB.
    progress
        Called with the finished fraction.
    cache
        Folder of solved wavelengths; the user's cache by default. A stopped sweep goes on from there.

    Returns
    -------
    See `complete`.

    Raises
    ------
    ValueError
        If a wavelength lies outside the metal's data, or the extra is not installed.
    """
    um = spectral.check_wavelengths(wavelength_um)
    eps = permittivity(design.metal, um)
    rows = sweep(design, um.tolist(), eps.tolist(), workers=workers, progress=progress, folder=cache)
    table = xr.Dataset(
        {
            name: ("wavelength", np.array([row[name] for row in rows]), {"units": "1", "long_name": what})
            for name, what in SOLVED.items()
        },
        coords={"wavelength": ("wavelength", um, {"units": "um"})},
        attrs={
            "title": "Response of a pixel-sized wire-grid polarizer",
            "design": design.model_dump_json(),
            "source": "2-D finite elements of Maxwell's equations, glintrack.devices.wire_grid.fem; metal: "
            + describe_metal(design),
            "licence": "BSD-3-Clause",
            "order": json.dumps(sorted({design.fem.order_at(x) for x in um.tolist()})),
            "elements": json.dumps(sorted({row["elements"] for row in rows})),
            "versions": json.dumps({"glintrack": version("glintrack"), "ngsolve": rows[0]["ngsolve"]}),
        },
    )
    return complete(table)


def field_maps(design: WireGridDesign, wavelength_um: float) -> xr.Dataset:
    """Field in the cross-section at one wavelength, solved now (extra ``em``); see `field_map.field_maps`."""
    require_solver()
    (um,) = spectral.check_wavelengths(wavelength_um)
    return import_module("glintrack.devices.wire_grid.field_map").field_maps(design, float(um))


def can_solve() -> bool:
    """Whether the extra ``em`` is installed."""
    return has_solver()


def complete(table: xr.Dataset) -> xr.Dataset:
    """Add what follows from the solved variables.

    Returns
    -------
    The table with, over ``wavelength``: ``pass_transmittance_per_aperture`` and
    ``block_transmittance_per_aperture``, the response to light that falls on the aperture alone (Eq. (7)
    times port over aperture; it may exceed 1, as the removed run loses light through the sides);
    ``extinction_ratio``, Eq. (8); ``diattenuation``, Eq. (9); ``retardance``, the phase of the pass amplitude
    less that of the block one, e^(−iωt) [rad]; ``transmittance`` T(λ, ψ) over ``polarization_angle`` [rad];
    ``mueller``, of the linear diattenuator with its pass axis along the reference axis, and
    ``mueller_per_aperture``, which a sensor flies.
    """
    design = WireGridDesign.model_validate_json(table.attrs["design"])
    share = design.aperture_um / design.port_um
    passed, blocked = table["pass_transmittance"], table["block_transmittance"]
    psi = np.radians(ANGLES_DEG)
    retardance = np.angle(field_ratio(table))
    matrices = [
        _mueller(p, b, r)
        for p, b, r in zip(passed.values.tolist(), blocked.values.tolist(), retardance.tolist(), strict=True)
    ]
    wave = "wavelength"
    both = passed.values + blocked.values
    return table.assign(
        pass_transmittance_per_aperture=(wave, passed.values / share, {"units": "1"}),
        block_transmittance_per_aperture=(wave, blocked.values / share, {"units": "1"}),
        extinction_ratio=(wave, passed.values / blocked.values, {"units": "1", "long_name": "Eq. (8)"}),
        diattenuation=(wave, (passed.values - blocked.values) / both, {"units": "1", "long_name": "Eq. (9)"}),
        retardance=(wave, retardance, {"units": "rad"}),
        transmittance=((wave, "polarization_angle"), transmittance(table, psi), {"units": "1"}),
        mueller=((wave, "stokes_out", "stokes_in"), np.array(matrices), {"units": "1"}),
        mueller_per_aperture=((wave, "stokes_out", "stokes_in"), np.array(matrices) / share, {"units": "1"}),
    ).assign_coords(
        polarization_angle=("polarization_angle", psi, {"units": "rad"}),
        stokes_out=("stokes_out", list(stokes.COMPONENTS)),
        stokes_in=("stokes_in", list(stokes.COMPONENTS)),
    )


def _mueller(passed: float, blocked: float, retardance_rad: float) -> Float[Array, "4 4"]:
    """Matrix of a linear diattenuator; Eq. (7) may exceed 1, as the removed run loses light to the sides."""
    scale = max(1.0, passed, blocked)
    return scale * stokes.linear_diattenuator(passed / scale, blocked / scale, 0.0, retardance_rad)


def field_ratio(table: xr.Dataset) -> Complex[Array, "wavelength"]:
    """Complex amplitude behind the pixel, pass over block, e^(−iωt). [1]"""
    return table["field_ratio_real"].values + 1j * table["field_ratio_imag"].values


def transmittance(table: xr.Dataset, angle_rad: ArrayLike) -> Float[Array, "wavelength *angle"]:
    """T(λ, ψ) = T(0°) cos²ψ + T(90°) sin²ψ, Eq. (7); exact where nothing varies along the wires. [1]

    Parameters
    ----------
    table
        From `load` or `solve`.
    angle_rad
        ψ, of the light's polarization from the pass axis. [rad]
    """
    psi = np.asarray(angle_rad, dtype=float)
    passed, blocked = table["pass_transmittance"].values, table["block_transmittance"].values
    return np.multiply.outer(passed, np.cos(psi) ** 2) + np.multiply.outer(blocked, np.sin(psi) ** 2)


def describe_metal(design: WireGridDesign) -> str:
    """The wires' metal and the source of its optical constants in a few words."""
    metal = design.metal
    if metal.model == "conductivity":
        return f"conductor of {metal.conductivity_s_per_m:g} S/m (ε = 1 + iσ/(ωε₀))"
    if metal.table is not None:
        return f"n and k tabulated in {metal.table.name}"
    return f"{metal.name} by the Lorentz–Drude model of Rakić et al., Applied Optics 37, 5271 (1998)"
