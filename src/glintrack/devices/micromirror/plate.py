"""The micromirror's plate as it bends: electrostatics, current, heat and mechanics in turn until they agree.

Current through the plate (Joule heat) and absorbed light warm it, gas and legs cool it, film and plate then
grow apart and bow it; the electrodes pull on the bowed plate. Each is a finite-element solve
(`devices.sheet`); the pull is linearised about the last deflection (Newton), heat and current are staggered.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.constants import epsilon_0

from glintrack.core.arrays import Array
from glintrack.devices.micromirror.equilibrium import ELECTRODE_ANGLES_RAD, MicromirrorDesign, pull_in
from glintrack.devices.micromirror.laminate import Laminate, laminate
from glintrack.devices.micromirror.sheet import Deflection, Potential, Sheet

_NEWTON_STEPS, _STAGGERS = 60, 30
_AGREED = 1e-6  # of the gap (a picometre) and of the temperature: far below what the mesh resolves


@dataclass(frozen=True)
class PlateShape:
    """A deflection split into a plane and the rest.

    Parameters
    ----------
    piston_m, tip_rad, tilt_rad
        Of the plane that fits best: toward the electrodes, slope along +x, slope along +y.
    bow_rms_m, bow_peak_to_valley_m
        Of what the plane leaves. [m]
    curvature_per_m
        Of the best-fitting paraboloid, positive where the mirror side is convex. [1/m]
    """

    piston_m: float
    tip_rad: float
    tilt_rad: float
    bow_rms_m: float
    bow_peak_to_valley_m: float
    curvature_per_m: float


def bend_plate(
    design: MicromirrorDesign, voltages_v: tuple[float, float, float] | None = None, cells: int = 24
) -> xr.Dataset:
    """Shape and temperature of the plate under voltage, current and light, at rest.

    Parameters
    ----------
    voltages_v
        On the electrodes; the design's by default. [V]
    cells
        Of the mesh along a side.

    Returns
    -------
    ``deflection`` toward the electrodes [m], ``temperature_rise`` [K] and ``voltage_drop`` of the drive
    current [V] over (y, x) [m], and as attributes the fields of `PlateShape`, ``joule_w``, ``absorbed_w`` and
    ``temperature_rise_max_k``.

    Raises
    ------
    ValueError
        Beyond pull-in, with the rigid plate's limit; where heat runs away; without scikit-fem.
    """
    voltages = np.asarray(design.drive.voltages_v if voltages_v is None else voltages_v, float)
    sheet = Sheet(design.plate.side_um * 1e-6, cells)
    layers = laminate(design.plate)
    legs = _around(sheet, design.actuator.spring_radius_um, design.actuator.leg_radius_um, soft=True)
    pads = _around(
        sheet, design.actuator.electrode_radius_um, np.sqrt(design.actuator.electrode_area_um2 / np.pi), False
    )
    warmth = np.zeros_like(sheet.area)
    bent = _pull(design, sheet, layers, legs, pads, voltages, warmth, None)
    for _ in range(_STAGGERS):
        current, joule = _current(design, sheet, legs, warmth)
        heat = _warm(design, sheet, legs, joule, bent.at_points)
        change = np.abs(heat.at_points - warmth).max()
        warmth = heat.at_points
        before = bent.at_points
        bent = _pull(design, sheet, layers, legs, pads, voltages, warmth, before)
        moved = np.abs(bent.at_points - before).max()
        if change <= _AGREED * max(warmth.max(), 1e-6) and moved <= _AGREED * _gap(design):
            break
    else:
        raise ValueError(
            f"`drive.current_ma` must be low enough for heat and resistance to settle, "
            f"got {design.drive.current_ma:g}, which runs away"
        )
    return _labelled(design, sheet, bent, heat, current, float(np.sum(joule * sheet.area)), voltages)


def plate_shape(
    sheet: Sheet, deflection_m: Float[Array, "element point"], nodal_m: Float[Array, "node"]
) -> PlateShape:
    """Best plane of a deflection, and its bow."""
    x, y = sheet.points
    root = np.sqrt(sheet.area).ravel()
    bowl = (x**2 + y**2) / 2
    columns = np.stack([np.ones_like(x), x, y, bowl - np.average(bowl, weights=sheet.area)], axis=-1)
    matrix = columns.reshape(-1, 4) / np.array([1, sheet.side_m, sheet.side_m, sheet.side_m**2])
    found = np.linalg.lstsq(matrix * root[:, None], deflection_m.ravel() * root, rcond=None)[0]
    found = found / np.array([1, sheet.side_m, sheet.side_m, sheet.side_m**2])
    rest = deflection_m - found[0] - found[1] * x - found[2] * y
    line = np.linspace(-sheet.side_m / 2, sheet.side_m / 2, sheet.cells + 1)
    corners = sheet.on_grid(nodal_m) - found[0] - found[1] * line - found[2] * line[:, None]
    return PlateShape(
        *(float(v) for v in found[:3]),
        bow_rms_m=float(np.sqrt(np.average(rest**2, weights=sheet.area))),
        bow_peak_to_valley_m=float(np.ptp(corners)),
        curvature_per_m=float(found[3]),
    )


def _gap(design: MicromirrorDesign) -> float:
    return design.actuator.electrode_gap_um * 1e-6


def _around(sheet: Sheet, circle_um: float, spot_um: float, soft: bool) -> list[Array]:
    """Three spots of integral 1 on a circle. [1/m²]"""
    r = circle_um * 1e-6
    return [
        sheet.spot(r * np.cos(a), r * np.sin(a), float(spot_um) * 1e-6, soft) for a in ELECTRODE_ANGLES_RAD
    ]


def _current(
    design: MicromirrorDesign, sheet: Sheet, legs: list[Array], warmth: Array
) -> tuple[Potential, Array]:
    """Voltage drop of the drive current, and its heat per area. [V, W/m²]"""
    p, ampere = design.plate, design.drive.current_ma * 1e-3
    cold = p.thickness_nm * 1e-9 / (p.resistivity_nohm_m * 1e-9)
    conductance = cold / (1 + p.resistivity_growth_per_k * warmth)
    fed = ampere * (legs[0] - 0.5 * (legs[1] + legs[2]))
    drop = sheet.conduct(conductance, fed)
    return drop, conductance * drop.squared_gradient


def _warm(
    design: MicromirrorDesign, sheet: Sheet, legs: list[Array], joule: Array, deflection: Array
) -> Potential:
    """Temperature above the surroundings. [K]"""
    p, d = design.plate, design.drive
    absorbed = (1 - design.surface.reflectance) * d.irradiance_w_m2
    through_gas = d.air_conductivity_w_m_k / (_gap(design) - deflection)
    through_legs = d.leg_conductance_uw_k * 1e-6 * (legs[0] + legs[1] + legs[2])
    sheet_conductance = p.conductivity_w_m_k * p.thickness_nm * 1e-9
    return sheet.conduct(sheet_conductance, absorbed + joule, through_gas + through_legs)


def _pull(
    design: MicromirrorDesign,
    sheet: Sheet,
    layers: Laminate,
    legs: list[Array],
    pads: list[Array],
    voltages: Array,
    warmth: Array,
    start: Array | None,
) -> Deflection:
    """Deflection under the electrodes' pull and the heat's bow, by Newton's method from rest or a start."""
    a, gap = design.actuator, _gap(design)
    held = a.spring_n_per_m * (legs[0] + legs[1] + legs[2])
    charged = sum(v**2 * pad for v, pad in zip(voltages, pads, strict=True))
    charged = 0.5 * epsilon_0 * a.electrode_area_um2 * 1e-12 * charged
    moment = layers.moment_per_strain_n * (layers.misfit_strain + layers.misfit_per_k * warmth)
    where = np.zeros_like(sheet.area) if start is None else start
    smallest = np.inf
    for _ in range(_NEWTON_STEPS):
        pressure = charged / (gap - where) ** 2
        softening = 2 * pressure / (gap - where)
        bent = sheet.bend(
            layers.rigidity_nm,
            layers.poisson_ratio,
            pressure - softening * where,
            moment,
            held - softening,
        )
        step = np.abs(bent.at_points - where).max()
        where = bent.at_points
        if where.max() >= gap or step > max(10 * smallest, 0.01 * gap):
            break
        if step <= _AGREED * gap:
            return bent
        smallest = min(smallest, step)
    if not voltages.any():
        raise ValueError(
            f"`plate` must bow less than the electrode gap of {gap * 1e9:.4g} nm, got more from film stress "
            f"and a temperature rise of {warmth.max():.3g} K"
        )
    limit = ", ".join(f"{v:.4g}" for v in pull_in(design, (voltages[0], voltages[1], voltages[2])))
    raise ValueError(
        f"`drive.voltages_v` must stay below pull-in, near [{limit}] V for a rigid plate and lower for a "
        f"bent one, got [{', '.join(f'{v:.4g}' for v in voltages)}] V"
    )


def _labelled(
    design: MicromirrorDesign,
    sheet: Sheet,
    bent: Deflection,
    heat: Potential,
    drop: Potential,
    joule_w: float,
    voltages: Array,
) -> xr.Dataset:
    line = np.linspace(-sheet.side_m / 2, sheet.side_m / 2, sheet.cells + 1)
    shape = plate_shape(sheet, bent.at_points, bent.at_nodes)
    absorbed = (1 - design.surface.reflectance) * design.drive.irradiance_w_m2 * sheet.side_m**2
    return xr.Dataset(
        {
            "deflection": (("y", "x"), sheet.on_grid(bent.at_nodes), {"units": "m"}),
            "temperature_rise": (("y", "x"), sheet.on_grid(heat.at_nodes), {"units": "K"}),
            "voltage_drop": (("y", "x"), sheet.on_grid(drop.at_nodes), {"units": "V"}),
        },
        coords={"y": ("y", line, {"units": "m"}), "x": ("x", line, {"units": "m"})},
        attrs={
            **vars(shape),
            "voltages_v": list(voltages),
            "joule_w": joule_w,
            "absorbed_w": absorbed,
            "temperature_rise_max_k": float(heat.at_nodes.max()),
        },
    )
