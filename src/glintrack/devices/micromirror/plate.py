"""Bending and heat of a micromirror's plate, with the finite elements of a square sheet (extra ``em``).

Current through the plate (Joule heat) and absorbed light warm it, gas and legs cool it, film and plate then
grow apart and bow it; the electrodes pull on the bowed plate. Each is a finite-element solve: Morley elements
bend the sheet, linear ones conduct heat and current, scikit-fem does the work. The pull is linearised about
the last deflection (Newton), heat and current are staggered until they agree. Coordinates run from −side/2
to side/2, x right, y up. Plate and film are one sheet with biaxial moduli E/(1−ν) and equal strain across the
interface (Timoshenko's bimetal, for plates).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.constants import epsilon_0
from scipy.sparse.linalg import splu

from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra
from glintrack.devices.micromirror.equilibrium import (
    ELECTRODE_ANGLES_RAD,
    MicromirrorDesign,
    PlateDesign,
    pull_in,
)

_NEWTON_STEPS, _STAGGERS = 60, 30
_AGREED = 1e-6  # of the gap (a picometre) and of the temperature: far below what the mesh resolves
Field = Float[Array, "element point"]  # values at the quadrature points


@dataclass(frozen=True)
class Sheet:
    """A square cut into triangles.

    Parameters
    ----------
    side_m
        Side of the square. [m]
    cells
        Squares along a side, each of two triangles.

    Raises
    ------
    ValueError
        Without scikit-fem, naming the extra.
    """

    side_m: float
    cells: int = 32

    def __post_init__(self):
        """Ask for the extra, and for at least four cells."""
        _scikit_fem()
        if self.cells < 4:
            raise ValueError(f"`cells` must be 4 or more, got {self.cells}")

    @cached_property
    def _mesh(self) -> Any:
        line = np.linspace(-self.side_m / 2, self.side_m / 2, self.cells + 1)
        return _scikit_fem().MeshTri.init_tensor(line, line)

    @cached_property
    def _plate(self) -> Any:
        fem = _scikit_fem()
        return fem.Basis(self._mesh, fem.ElementTriMorley(), intorder=6)

    @cached_property
    def _linear(self) -> Any:
        fem = _scikit_fem()
        return fem.Basis(self._mesh, fem.ElementTriP1(), intorder=6)

    @property
    def points(self) -> tuple[Field, Field]:
        """x and y of the quadrature points, the same for bending and conduction. [m]"""
        x, y = self._linear.global_coordinates()
        return x, y

    @property
    def area(self) -> Field:
        """Area that each quadrature point stands for. [m²]"""
        return self._linear.dx

    def spot(self, x_m: float, y_m: float, radius_m: float, soft: bool = True) -> Field:
        """Density of a round spot, of integral 1: falling to its rim, or even. [1/m²]"""
        x, y = self.points
        away = ((x - x_m) ** 2 + (y - y_m) ** 2) / radius_m**2
        density = np.clip(1 - away, 0, None) if soft else (away <= 1).astype(float)
        total = np.sum(density * self.area)
        if total <= 0:
            raise ValueError(
                f"`radius` must reach a point of the mesh, got {radius_m * 1e6:.3g} µm "
                f"at ({x_m * 1e6:.3g}, {y_m * 1e6:.3g}) µm on a plate of {self.side_m * 1e6:.3g} µm"
            )
        return density / total

    def on_grid(self, nodal: Array) -> Float[Array, "y x"]:
        """Values at the mesh's nodes as an array, y rising."""
        column, row = np.rint((self._mesh.p / self.side_m + 0.5) * self.cells).astype(int)
        out = np.empty((self.cells + 1, self.cells + 1))
        out[row, column] = nodal
        return out

    def bend(
        self,
        rigidity_nm: float,
        poisson_ratio: float,
        pressure_pa: Field,
        moment_n: Field | float = 0.0,
        foundation_pa_m: Field | float = 0.0,
        edge: Literal["free", "clamped"] = "free",
    ) -> "Deflection":
        """Deflection under pressure and thermal moment on an elastic foundation (Kirchhoff's plate).

        Parameters
        ----------
        rigidity_nm, poisson_ratio
            Flexural rigidity [N m] and Poisson's ratio [1].
        pressure_pa
            In the direction of the deflection. [Pa]
        moment_n
            D(1+ν) times the curvature the free plate would take. [N]
        foundation_pa_m
            Force back per area and deflection; a free edge needs some. [Pa/m]
        """
        fem = _scikit_fem()
        dd, trace = fem.helpers.dd, fem.helpers.trace

        @fem.BilinearForm
        def energy(u, v, _):
            bent = (1 - poisson_ratio) * dd(u) + poisson_ratio * fem.helpers.eye(trace(dd(u)), 2)
            return rigidity_nm * fem.helpers.ddot(bent, dd(v))

        @fem.BilinearForm
        def hold(u, v, w):
            return w.foundation * u * v

        @fem.LinearForm
        def load(v, w):
            return w.pressure * v + w.moment * trace(dd(v))

        full = np.zeros_like(self.area)
        held = hold.assemble(self._plate, foundation=full + foundation_pa_m)
        bending = energy.assemble(self._plate)
        force = load.assemble(self._plate, pressure=full + pressure_pa, moment=full + moment_n)
        if edge == "clamped":
            solved = fem.solve(*fem.condense(bending + held, force, D=self._plate.get_dofs()))
        else:
            solved = self._free(bending, held, force)
        return Deflection(np.asarray(self._plate.interpolate(solved)), solved[self._plate.nodal_dofs[0]])

    @cached_property
    def _planes(self) -> Float[Array, "dof 3"]:
        """The plate's three rigid motions: level, and the two slopes of 1 over the side."""
        side = self.side_m
        motions = (
            lambda x: 1.0 + 0 * x[0],
            lambda x: x[0] / side,
            lambda x: x[1] / side,
        )
        return np.column_stack([self._plate.project(motion) for motion in motions])

    def _free(self, bending: Any, held: Any, force: Array) -> Array:
        """Solve with the rigid motions apart.

        They bend nothing. Left in one matrix with bending, which is stiffer by the fourth power of the number
        of cells, soft springs would drown in rounding errors.
        """
        corners = self._plate.nodal_dofs[0][[0, self.cells, -1]]
        kept = np.setdiff1d(np.arange(force.size), corners)
        planes = self._planes
        mixed, rigid = held @ planes, planes.T @ (held @ planes)
        solve = splu((bending + held)[kept][:, kept].tocsc()).solve
        against, under = solve(mixed[kept]), solve(force[kept])
        amount = np.linalg.solve(rigid - mixed[kept].T @ against, planes.T @ force - mixed[kept].T @ under)
        solved = planes @ amount
        solved[kept] += under - against @ amount
        return solved

    def conduct(
        self,
        sheet_conductance: Field | float,
        source: Field | float,
        loss: Field | float = 0.0,
        held: Callable[[Array, Array], Array] | None = None,
    ) -> "Potential":
        """Temperature (or voltage) of a sheet that conducts in its plane.

        Parameters
        ----------
        sheet_conductance
            Conductivity times thickness. [W/K, or S]
        source
            Heat (or current) fed in per area. [W/m², or A/m²]
        loss
            To the surroundings per area and kelvin. [W/(m² K)]
        held
            ``held(x, y)`` is true where the boundary stays at 0; without it, and without loss, the mean is 0.
        """
        fem = _scikit_fem()
        grad = fem.helpers.grad

        @fem.BilinearForm
        def flow(u, v, w):
            return w.conductance * fem.helpers.dot(grad(u), grad(v)) + w.loss * u * v

        @fem.LinearForm
        def feed(v, w):
            return w.source * v

        full = np.zeros_like(self.area)
        matrix = flow.assemble(self._linear, conductance=full + sheet_conductance, loss=full + loss)
        force = feed.assemble(self._linear, source=full + source)
        if held is not None:
            nodes = np.flatnonzero(held(*self._mesh.p))
            solved = fem.solve(*fem.condense(matrix, force, D=nodes))
        elif np.any(full + loss > 0):
            solved = fem.solve(matrix, force)
        else:
            solved = fem.solve(*fem.condense(matrix, force, D=np.array([0])))
            solved = solved - solved.mean()
        field = self._linear.interpolate(solved)
        return Potential(np.asarray(field), np.asarray(np.sum(field.grad**2, axis=0)), solved)


@dataclass(frozen=True)
class Deflection:
    """Of a plate, at the quadrature points and at the nodes. [m]"""

    at_points: Field
    at_nodes: Float[Array, "node"]


@dataclass(frozen=True)
class Potential:
    """Temperature or voltage at the quadrature points, its squared gradient there, and at the nodes."""

    at_points: Field
    squared_gradient: Field
    at_nodes: Float[Array, "node"]


def _scikit_fem() -> Any:
    """scikit-fem with its helpers, or the name of the extra that brings it."""
    require_extra("skfem.helpers", "em", "bend plates")
    return require_extra("skfem", "em", "bend plates")


@dataclass(frozen=True)
class Laminate:
    """Plate and film as one sheet.

    Parameters
    ----------
    rigidity_nm
        Flexural rigidity D. [N m]
    poisson_ratio
        Of the plate. [1]
    moment_per_strain_n
        Bending moment per length for a film that would be longer than the plate by a strain of 1. [N]
    misfit_strain
        How much longer the film would be, from its built-in stress, without heat. [1]
    misfit_per_k
        The same for each kelvin. [1/K]
    """

    rigidity_nm: float
    poisson_ratio: float
    moment_per_strain_n: float
    misfit_strain: float
    misfit_per_k: float


def laminate(plate: PlateDesign) -> Laminate:
    """Stiffness and misfit of a plate with its film.

    References
    ----------
    Timoshenko, J. Opt. Soc. Am. 11, 233 (1925); Freund and Suresh, Thin Film Materials, 2003, §2.1–2.2.
    """
    h, t = plate.thickness_nm * 1e-9, plate.film_thickness_nm * 1e-9
    biaxial = plate.youngs_modulus_gpa * 1e9 / (1 - plate.poisson_ratio)
    film = plate.film_youngs_modulus_gpa * 1e9 / (1 - plate.film_poisson_ratio)
    extension = biaxial * h + film * t  # heights are counted from the plate's middle toward the film
    middle = h / 2 + t / 2
    neutral = film * t * middle / extension
    bending = biaxial * (h**3 / 12 + h * neutral**2) + film * (t**3 / 12 + t * (middle - neutral) ** 2)
    return Laminate(
        rigidity_nm=bending / (1 + plate.poisson_ratio),
        poisson_ratio=plate.poisson_ratio,
        moment_per_strain_n=film * t * (middle - neutral),
        misfit_strain=-plate.film_stress_mpa * 1e6 / film,
        misfit_per_k=(plate.film_expansion_per_mk - plate.expansion_per_mk) * 1e-6,
    )


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
    current [V] over (y, x) [m], and as attributes ``piston_m``, ``tip_rad``, ``tilt_rad``,
    ``curvature_per_m``, ``bow_rms_m``, ``bow_peak_to_valley_m``, ``joule_w``, ``absorbed_w`` and
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


def _shape(sheet: Sheet, bent: Deflection) -> dict[str, float]:
    """Plane that fits a deflection best, the bow that it leaves, and the best-fitting paraboloid's curvature.

    Piston toward the electrodes, tip and tilt the slopes along +x and +y; curvature is positive where the
    mirror side is convex.
    """
    x, y = sheet.points
    root = np.sqrt(sheet.area).ravel()
    bowl = (x**2 + y**2) / 2
    columns = np.stack([np.ones_like(x), x, y, bowl - np.average(bowl, weights=sheet.area)], axis=-1)
    unit = np.array([1, sheet.side_m, sheet.side_m, sheet.side_m**2])
    matrix = columns.reshape(-1, 4) / unit
    found = np.linalg.lstsq(matrix * root[:, None], bent.at_points.ravel() * root, rcond=None)[0] / unit
    rest = bent.at_points - found[0] - found[1] * x - found[2] * y
    line = np.linspace(-sheet.side_m / 2, sheet.side_m / 2, sheet.cells + 1)
    corners = sheet.on_grid(bent.at_nodes) - found[0] - found[1] * line - found[2] * line[:, None]
    return {
        **dict(zip(("piston_m", "tip_rad", "tilt_rad", "curvature_per_m"), found.tolist(), strict=True)),
        "bow_rms_m": float(np.sqrt(np.average(rest**2, weights=sheet.area))),
        "bow_peak_to_valley_m": float(np.ptp(corners)),
    }


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
    absorbed = (1 - design.surface.reflectance) * design.drive.irradiance_w_m2 * sheet.side_m**2
    return xr.Dataset(
        {
            "deflection": (("y", "x"), sheet.on_grid(bent.at_nodes), {"units": "m"}),
            "temperature_rise": (("y", "x"), sheet.on_grid(heat.at_nodes), {"units": "K"}),
            "voltage_drop": (("y", "x"), sheet.on_grid(drop.at_nodes), {"units": "V"}),
        },
        coords={"y": ("y", line, {"units": "m"}), "x": ("x", line, {"units": "m"})},
        attrs={
            **_shape(sheet, bent),
            "voltages_v": list(voltages),
            "joule_w": joule_w,
            "absorbed_w": absorbed,
            "temperature_rise_max_k": float(heat.at_nodes.max()),
        },
    )
