"""Bending and heat of a micromirror's plate, with the finite elements of a square sheet (extra ``em``).

Current through the plate (Joule heat) and absorbed light warm it, gas and legs cool it. Film and plate expand
differently, which bows the plate, and the electrodes pull on the bowed plate. Each is a finite-element solve
with scikit-fem: Morley elements for bending, linear ones for heat and current. The pull is linearised about
the last deflection (Newton); heat and current are iterated until they agree. Coordinates run from −side/2
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
_TOLERANCE = 1e-6  # of the gap (a picometre) and of the temperature: far below what the mesh resolves
Field = Float[Array, "element point"]  # values at the quadrature points


@dataclass(frozen=True)
class SheetField:
    """A solved field at the quadrature points and at the nodes, and its squared gradient at the points."""

    at_points: Field
    at_nodes: Float[Array, "node"]
    squared_gradient: Field


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

    @cached_property
    def _fem(self) -> Any:
        require_extra("skfem.helpers", "em", "bend plates")
        return require_extra("skfem", "em", "bend plates")

    @cached_property
    def _plate(self) -> Any:
        line = np.linspace(-self.side_m / 2, self.side_m / 2, self.cells + 1)
        mesh = self._fem.MeshTri.init_tensor(line, line)
        return self._fem.Basis(mesh, self._fem.ElementTriMorley(), intorder=6)

    @cached_property
    def _linear(self) -> Any:
        return self._fem.Basis(self._plate.mesh, self._fem.ElementTriP1(), intorder=6)

    @property
    def points(self) -> tuple[Field, Field]:
        """x and y of the quadrature points, the same for bending and conduction. [m]"""
        x, y = self._linear.global_coordinates()
        return x, y

    @property
    def area(self) -> Field:
        """Area represented by each quadrature point. [m²]"""
        return self._linear.dx

    def spot(self, x_m: float, y_m: float, radius_m: float, soft: bool = True) -> Field:
        """Density of a round spot, of integral 1: falling to its rim, or even. [1/m²]"""
        x, y = self.points
        away = ((x - x_m) ** 2 + (y - y_m) ** 2) / radius_m**2
        density = np.clip(1 - away, 0, None) if soft else (away <= 1).astype(float)
        total = np.sum(density * self.area)
        if total <= 0:
            raise ValueError(
                f"`radius` must reach a point of the mesh; got {radius_m * 1e6:.3g} µm "
                f"at ({x_m * 1e6:.3g}, {y_m * 1e6:.3g}) µm on a plate of {self.side_m * 1e6:.3g} µm."
            )
        return density / total

    def on_grid(self, nodal: Array) -> Float[Array, "y x"]:
        """Values at the mesh's nodes as an array, y rising."""
        column, row = np.rint((self._plate.mesh.p / self.side_m + 0.5) * self.cells).astype(int)
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
    ) -> SheetField:
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
        fem = self._fem
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
        field = self._plate.interpolate(solved)
        return SheetField(
            np.asarray(field), solved[self._plate.nodal_dofs[0]], np.sum(np.asarray(field.grad) ** 2, axis=0)
        )

    def _free(self, bending: Any, held: Any, force: Array) -> Array:
        """Solve with separate rigid motions: soft springs would be lost in the rounding of stiff bending."""
        corners = self._plate.nodal_dofs[0][[0, self.cells, -1]]
        inner = np.setdiff1d(np.arange(force.size), corners)
        # the three rigid motions: level, and the two slopes of 1 over the side
        motions = (lambda x: 1.0 + 0 * x[0], lambda x: x[0] / self.side_m, lambda x: x[1] / self.side_m)
        planes = np.column_stack([self._plate.project(motion) for motion in motions])
        mixed, rigid = held @ planes, planes.T @ (held @ planes)
        solve = splu((bending + held)[inner][:, inner].tocsc()).solve
        against, under = solve(mixed[inner]), solve(force[inner])
        amount = np.linalg.solve(rigid - mixed[inner].T @ against, planes.T @ force - mixed[inner].T @ under)
        solved = planes @ amount
        solved[inner] += under - against @ amount
        return solved

    def conduct(
        self,
        sheet_conductance: Field | float,
        source: Field | float,
        loss: Field | float = 0.0,
        held: Callable[[Array, Array], Array] | None = None,
    ) -> SheetField:
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
        fem = self._fem
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
            nodes = np.flatnonzero(held(*self._plate.mesh.p))
            solved = fem.solve(*fem.condense(matrix, force, D=nodes))
        elif np.any(full + loss > 0):
            solved = fem.solve(matrix, force)
        else:
            solved = fem.solve(*fem.condense(matrix, force, D=np.array([0])))
            solved = solved - solved.mean()
        field = self._linear.interpolate(solved)
        return SheetField(np.asarray(field), solved, np.asarray(np.sum(field.grad**2, axis=0)))


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
    misfit_strain, misfit_per_k
        Relative excess length of the free film: from its built-in stress, and per kelvin. [1, 1/K]
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
        Number of mesh cells along a side.

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
    p, d, a, gap = design.plate, design.drive, design.actuator, design.actuator.gap_m
    sheet = Sheet(p.side_m, cells)
    legs = _around(sheet, a.spring_radius_m, a.leg_radius_um * 1e-6, soft=True)
    pads = _around(sheet, a.electrode_radius_m, float(np.sqrt(a.electrode_area_um2 / np.pi)) * 1e-6, False)
    spring = a.spring_n_per_m * (legs[0] + legs[1] + legs[2])
    charge = 0.5 * epsilon_0 * a.electrode_area_m2 * (voltages**2 @ pads.swapaxes(0, 1))
    cold = p.thickness_nm * 1e-9 / (p.resistivity_nohm_m * 1e-9)
    fed = d.current_ma * 1e-3 * (legs[0] - 0.5 * (legs[1] + legs[2]))
    absorbed = (1 - design.surface.reflectance) * d.irradiance_w_m2
    through_legs = d.leg_conductance_uw_k * 1e-6 * (legs[0] + legs[1] + legs[2])
    warmth = np.zeros_like(sheet.area)
    bent = _pull(design, sheet, spring, charge, voltages, warmth, warmth)
    for _ in range(_STAGGERS):
        conductance = cold / (1 + p.resistivity_growth_per_k * warmth)
        drop = sheet.conduct(conductance, fed)
        joule = conductance * drop.squared_gradient
        through_gas = d.air_conductivity_w_m_k / (gap - bent.at_points)
        heat = sheet.conduct(
            p.conductivity_w_m_k * p.thickness_nm * 1e-9, absorbed + joule, through_gas + through_legs
        )
        change, warmth, before = np.abs(heat.at_points - warmth).max(), heat.at_points, bent.at_points
        bent = _pull(design, sheet, spring, charge, voltages, warmth, before)
        moved = np.abs(bent.at_points - before).max()
        if change <= _TOLERANCE * max(warmth.max(), 1e-6) and moved <= _TOLERANCE * gap:
            break
    else:
        raise ValueError(
            f"`drive.current_ma` must be low enough for heat and resistance to settle; "
            f"got {design.drive.current_ma:g}, which runs away."
        )
    line = np.linspace(-sheet.side_m / 2, sheet.side_m / 2, cells + 1)
    maps = {"deflection": (bent, "m"), "temperature_rise": (heat, "K"), "voltage_drop": (drop, "V")}
    return xr.Dataset(
        {n: (("y", "x"), sheet.on_grid(field.at_nodes), {"units": u}) for n, (field, u) in maps.items()},
        coords={axis: (axis, line, {"units": "m"}) for axis in ("y", "x")},
        attrs={
            **_shape(sheet, bent, line),
            "voltages_v": list(voltages),
            "joule_w": float(np.sum(joule * sheet.area)),
            "absorbed_w": absorbed * sheet.side_m**2,
            "temperature_rise_max_k": float(heat.at_nodes.max()),
        },
    )


def _shape(sheet: Sheet, bent: SheetField, line: Array) -> dict[str, float]:
    """Best-fitting plane of a deflection, the bow it leaves, and the best-fitting paraboloid's curvature.

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
    corners = sheet.on_grid(bent.at_nodes) - found[0] - found[1] * line - found[2] * line[:, None]
    return {
        **dict(zip(("piston_m", "tip_rad", "tilt_rad", "curvature_per_m"), found.tolist(), strict=True)),
        "bow_rms_m": float(np.sqrt(np.average(rest**2, weights=sheet.area))),
        "bow_peak_to_valley_m": float(np.ptp(corners)),
    }


def _around(sheet: Sheet, circle_m: float, spot_m: float, soft: bool) -> Float[Array, "3 element point"]:
    """Three spots of integral 1 on a circle. [1/m²]"""
    angles = ELECTRODE_ANGLES_RAD
    return np.stack([sheet.spot(circle_m * np.cos(a), circle_m * np.sin(a), spot_m, soft) for a in angles])


def _pull(
    design: MicromirrorDesign,
    sheet: Sheet,
    spring: Field,
    charge: Field,
    voltages: Array,
    warmth: Field,
    where: Field,
) -> SheetField:
    """Deflection under the electrodes' pull and the heat's bow, by Newton's method from a start."""
    gap, layers = design.actuator.gap_m, laminate(design.plate)
    moment = layers.moment_per_strain_n * (layers.misfit_strain + layers.misfit_per_k * warmth)
    smallest = np.inf
    for _ in range(_NEWTON_STEPS):
        pressure = charge / (gap - where) ** 2
        softening = 2 * pressure / (gap - where)
        load = pressure - softening * where
        bent = sheet.bend(layers.rigidity_nm, layers.poisson_ratio, load, moment, spring - softening)
        step = np.abs(bent.at_points - where).max()
        where = bent.at_points
        if where.max() >= gap or step > max(10 * smallest, 0.01 * gap):
            break
        if step <= _TOLERANCE * gap:
            return bent
        smallest = min(smallest, step)
    if not voltages.any():
        raise ValueError(
            f"`plate` must bow less than the electrode gap of {gap * 1e9:.4g} nm; got more from film stress "
            f"and a temperature rise of {warmth.max():.3g} K."
        )
    limit = ", ".join(f"{v:.4g}" for v in pull_in(design, (voltages[0], voltages[1], voltages[2])))
    raise ValueError(
        f"`drive.voltages_v` must stay below pull-in, near [{limit}] V for a rigid plate and lower for a "
        f"bent one; got [{', '.join(f'{v:.4g}' for v in voltages)}] V."
    )
