"""Finite elements of a square sheet: bending (Morley), and conduction of heat or current (linear).

scikit-fem does the work (extra ``em``). Coordinates run from −side/2 to side/2, x right, y up.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.sparse.linalg import splu

from glintrack.core.arrays import Array
from glintrack.core.extras import require_extra

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
