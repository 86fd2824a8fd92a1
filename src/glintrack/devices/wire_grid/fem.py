"""Two-dimensional Maxwell finite elements of a wire grid in its plate (§3.1), with NGSolve (extra ``em``).

One scalar unknown a polarization: E along the wires ("block"; u = E_y, zero on the plate) or H along the
wires ("pass"; u = H_y, natural on the plate), with H in units of E over the vacuum impedance. Lengths are µm,
fields e^(−iωt), light travels toward +z. The mirror plane x = 0 halves the space; perfectly matched layers
surround it and the plate runs on through them. A line of sources across the input port |x| < port/2,
z = −depth/2, sends out a wave of amplitude 1.

Run as a module it solves wavelengths of one pixel for `table`, one request and one answer per line. A
separate process limits NGSolve and OpenBLAS to one thread before they load.

Notes
-----
∇·(a ∇u) + k² b u = source with a = 1, b = ε for E and a = 1/ε, b = 1 for H. A source line of strength −2ik
radiates a plane wave of amplitude 1 to both sides.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Literal

import ngsolve as ng
import numpy as np
import xarray as xr
from jaxtyping import Complex, Float
from netgen import occ as _netgen_occ

from glintrack.core.arrays import Array
from glintrack.devices.optical_constants import permittivity
from glintrack.devices.wire_grid.design import WireGridDesign

occ: Any = _netgen_occ  # its classes come from a compiled module that type checkers cannot read
Polarization = Literal["pass", "block"]
_ON_LINE_UM = 1e-7  # two coordinates closer than this are the same line of the drawing
_INSIDE_UM = 1e-6  # the output is read this far inside, so that every point is in one element
PAST_SOURCE_UM = 0.5  # the input is read this far behind the source line, which has singular ends
_PORT_STEP_UM = 0.05
_PORT_POINTS = 6  # Gauss points a step: exact to degree 11 on a piece a quarter of an element long


@dataclass(frozen=True)
class Space:
    """A meshed half space x ≥ 0 and its ports.

    Parameters
    ----------
    mesh
        NGSolve's, with the PML set by each solve.
    half_port_um, input_um, output_um
        Ports reach from x = 0 to the first, at z of the others. [µm]
    exit_permittivity
        ε behind the wires. [1]
    """

    mesh: ng.Mesh
    half_port_um: float
    input_um: float
    output_um: float
    exit_permittivity: float


@dataclass(frozen=True)
class PortField:
    """Transverse E and its partner H along a port; the power through it is Σ weight · Re(E H*).

    Parameters
    ----------
    electric, magnetic
        (E_x, H_y) for the pass polarization, (E_y, −H_x) for the block one. [1]
    weight
        Of the quadrature over 0 ≤ x ≤ port/2. [µm]
    """

    electric: Complex[Array, "point"]
    magnetic: Complex[Array, "point"]
    weight: Float[Array, "point"]

    def power(self) -> float:
        """Power toward +z through half the port, per incident irradiance. [µm]"""
        return float(np.sum(self.weight * np.real(self.electric * self.magnetic.conj())))

    def mean_electric(self) -> complex:
        """Mean field: the amplitude of the wave that leaves straight on. [1]"""
        return complex(np.sum(self.weight * self.electric) / np.sum(self.weight))

    def interference_power(self, other: "PortField") -> complex:
        """Interference power ½ Σ weight (E H'* + H E'*); with itself its real part is `power`. [µm]"""
        mixed = self.electric * other.magnetic.conj() + self.magnetic * other.electric.conj()
        return complex(0.5 * np.sum(self.weight * mixed))

    def __sub__(self, other: "PortField") -> "PortField":
        """Scattered field: this one less the incident one."""
        return PortField(self.electric - other.electric, self.magnetic - other.magnetic, self.weight)


@dataclass(frozen=True)
class Solution:
    """One solved polarization: field, ports, and power absorbed in half the wires [µm]."""

    field: ng.GridFunction
    input: PortField
    output: PortField
    absorbed_um: float


def grid_space(design: WireGridDesign, wavelength_um: float) -> Space:
    """Mesh the grid in its plate for a wavelength; the mirror plane cuts the central wire or gap."""
    d, count = design.period_nm * 1e-3, (design.wires + 1) // 2
    first = 0.0 if design.wires % 2 else d / 2
    wires = [_wire(first + i * d, design, wavelength_um) for i in range(count)]
    half_port, half_aperture = design.port_um / 2, design.aperture_um / 2
    return _space(design, wavelength_um, half_port, wires, half_aperture)


def free_space(design: WireGridDesign, wavelength_um: float) -> Space:
    """Mesh the same space with neither grid nor plate nor substrate: the paper's "grid removed"."""
    return _space(design, wavelength_um, design.port_um / 2)


def unit_cell(design: WireGridDesign, wavelength_um: float) -> Space:
    """Mesh half a period of the infinite grid between two mirror planes, to compare with grating theory."""
    half = design.period_nm * 5e-4
    return _space(design, wavelength_um, half, [_wire(0.0, design, wavelength_um)], half, periodic=True)


def _space(
    design: WireGridDesign,
    wavelength_um: float,
    half_um: float,
    wires: Sequence[Any] = (),
    half_gap_um: float = np.inf,
    periodic: bool = False,
) -> Space:
    """Mesh wires in a gap between two ports, with absorbing layers, and name every edge."""
    z_in, z_out, thick = -design.depth_um / 2, design.depth_um / 2, design.wire_height_nm * 1e-3
    h, pml, faces = design.fem.air_element_at(wavelength_um), design.pml_um, []
    stack = [(z_in - pml, z_in, "pml_air"), (z_in, z_out, "air"), (z_out, z_out + pml, "pml_air")]
    if len(wires):
        gap = _rectangle(0, half_gap_um, 0, thick, "gap")
        for wire in wires:
            gap = gap - wire
        gap.faces.name = "gap"
        faces = [gap, *wires]
        stack[1:] = [(z_in, 0, "air"), (thick, z_out, "exit"), (z_out, z_out + pml, "pml_exit")]
    columns = [(0.0, half_um, "")]
    if periodic:
        h = min(h, half_um)
    else:
        columns.append((half_um, half_um + pml, "pml_"))
    for x0, x1, side in columns:
        for z0, z1, material in stack:
            name = material if material.startswith("pml_") else side + material
            faces.append(_rectangle(x0, x1, z0, z1, name, h))
    outermost = np.inf if periodic else half_um + pml

    def edge_name(x: float, z: float, flat: bool) -> str:
        if flat and _same(z, z_in) and x < half_um:
            return "input"
        if not periodic and x > half_gap_um - _ON_LINE_UM and -_ON_LINE_UM < z < thick + _ON_LINE_UM:
            if not flat or x > half_gap_um:
                return "plate" if not _same(x, outermost) else "outer"
        outer = _same(z, z_in - pml) or _same(z, z_out + pml) or _same(x, outermost)
        return "outer" if outer else "inner"

    shape = occ.Glue(faces)
    for edge in shape.edges:
        box = edge.bounding_box
        edge.name = edge_name(edge.center.x, edge.center.y, box[1].y - box[0].y < 1e-5)
    mesh = ng.Mesh(occ.OCCGeometry(shape, dim=2).GenerateMesh(maxh=h, grading=0.3))
    return Space(mesh, half_um, z_in, z_out, design.substrate_index**2 if len(wires) else 1.0)


def solve(
    space: Space, wavelength_um: float, polarization: Polarization, permittivity: complex, order: int
) -> Solution:
    """Solve one polarization at one wavelength.

    Parameters
    ----------
    space
        From `grid_space`, `free_space` or `unit_cell`.
    wavelength_um
        In vacuum. [µm]
    polarization
        ``"pass"``: E across the wires; ``"block"``: E along them.
    permittivity
        Of the wires, Im ≥ 0. [1]
    order
        Polynomial order of the elements.
    """
    k = 2 * np.pi / wavelength_um
    absorb_in_layers(space, wavelength_um)
    dirichlet = "plate|outer" if polarization == "block" else "outer"
    elements = ng.H1(space.mesh, order=order, complex=True, dirichlet=dirichlet)
    u, v = elements.TnT()
    system = ng.BilinearForm(elements, symmetric=True, condense=True)
    system += wave_operator(space, u, v, k, polarization, permittivity)
    source = ng.LinearForm(elements)
    source += -2j * k * v * ng.ds("input")
    system.Assemble()
    source.Assemble()
    field = ng.GridFunction(elements)
    inverse = system.mat.Inverse(elements.FreeDofs(coupling=True), inverse="sparsecholesky")
    right = source.vec
    right.data += system.harmonic_extension_trans * right
    field.vec.data = inverse * right
    field.vec.data += system.harmonic_extension * field.vec
    field.vec.data += system.inner_solve * right
    return Solution(
        field,
        port_field(space, field, k, polarization, space.input_um + PAST_SOURCE_UM, 1.0),
        port_field(space, field, k, polarization, space.output_um - _INSIDE_UM, space.exit_permittivity),
        _absorption(space, field, k, polarization, permittivity),
    )


def wave_operator(
    space: Space, u, v, k: float, polarization: Polarization, permittivity: complex
) -> ng.comp.SumOfIntegrals:
    """Weak form a(u, v) of the Helmholtz equation of one polarization, k in rad µm⁻¹."""
    eps = permittivity_map(space, permittivity)
    if polarization == "block":
        return (ng.grad(u) * ng.grad(v) - k * k * eps * u * v) * ng.dx
    return (1 / eps * ng.grad(u) * ng.grad(v) - k * k * u * v) * ng.dx


def absorb_in_layers(space: Space, wavelength_um: float) -> None:
    """Set the perfectly matched layers for a wavelength."""
    # the layer is 1 µm thick: longer waves need more absorption per length to die out in it
    strength = 1.5j * max(1.0, wavelength_um)
    layer = ng.pml.Cartesian(
        mins=(-space.half_port_um, space.input_um), maxs=(space.half_port_um, space.output_um), alpha=strength
    )
    space.mesh.SetPML(layer, "pml_.*")


def port_field(
    space: Space, field: ng.GridFunction, k: float, polarization: Polarization, z_um: float, eps: float
) -> PortField:
    """Transverse E and H of a solved field along 0 ≤ x ≤ port/2 at one z, with permittivity ``eps``."""
    pieces = max(8, int(np.ceil(space.half_port_um / _PORT_STEP_UM)))
    node, weight = np.polynomial.legendre.leggauss(_PORT_POINTS)
    half = space.half_port_um / pieces / 2
    x = (half * (2 * np.arange(pieces)[:, None] + 1 + node)).ravel()
    points = space.mesh(x, np.full_like(x, z_um))
    u = field(points).ravel()
    slope = ng.grad(field)(points)[:, 1] / (1j * k)
    weights = np.tile(half * weight, pieces)
    if polarization == "block":
        return PortField(u, slope, weights)
    return PortField(slope / eps, u, weights)


def _absorption(
    space: Space, field: ng.GridFunction, k: float, polarization: Polarization, permittivity: complex
) -> float:
    """k ∫ Im ε |E|² over half the wires: power lost there, per incident irradiance. [µm]"""
    if "wire" not in space.mesh.GetMaterials() or permittivity.imag == 0:
        return 0.0
    region = space.mesh.Materials("wire")
    if polarization == "block":
        return k * permittivity.imag * ng.Integrate(ng.Norm(field) ** 2, space.mesh, definedon=region)
    gradient = ng.grad(field)
    square = ng.Norm(gradient[0]) ** 2 + ng.Norm(gradient[1]) ** 2
    integral = ng.Integrate(square, space.mesh, definedon=region)
    return permittivity.imag / abs(permittivity) ** 2 / k * integral


def permittivity_map(space: Space, wire: complex) -> ng.CoefficientFunction:
    """Relative permittivity over the space, ``wire`` in the wires. [1]"""
    behind = space.exit_permittivity
    return space.mesh.MaterialCF({"wire": wire, "exit": behind, "pml_exit": behind}, default=ng.CF(1.0))


def _wire(centre_um: float, design: WireGridDesign, wavelength_um: float) -> Any:
    """Cross-section of one wire, cut off at x = 0."""
    top, base, t = design.top_width_um / 2, design.base_width_um / 2, design.wire_height_nm * 1e-3
    corners = [(-top, 0.0), (top, 0.0), (base, t), (-base, t)]
    element_um = design.fem.wire_element_at(wavelength_um)
    return _polygon([(max(centre_um + x, 0.0), z) for x, z in corners], "wire", element_um)


def _rectangle(x0: float, x1: float, z0: float, z1: float, name: str, element_um: float = 0.0) -> Any:
    return _polygon([(x0, z0), (x1, z0), (x1, z1), (x0, z1)], name, element_um)


def _polygon(corners: list[tuple[float, float]], name: str, element_um: float) -> Any:
    plane = occ.WorkPlane()
    plane.MoveTo(*corners[0])
    for corner in corners[1:]:
        plane.LineTo(*corner)
    face = plane.Close().Face()
    face.faces.name = name
    if element_um:
        face.faces.maxh = element_um
    return face


def _same(a: float, b: float) -> bool:
    return abs(a - b) < _ON_LINE_UM


@dataclass(frozen=True)
class Pixel:
    """A design with its two meshes: the grid in its plate, and the space with all removed."""

    design: WireGridDesign
    grid: Space
    free: Space

    @classmethod
    def of(cls, design: WireGridDesign, wavelength_um: float) -> "Pixel":
        """Mesh a design for a wavelength; the same mesh serves all with the same element sizes."""
        return cls(design, grid_space(design, wavelength_um), free_space(design, wavelength_um))


def measure(pixel: Pixel, wavelength_um: float, permittivity: complex) -> dict[str, float]:
    """Solve both polarizations and the removed run.

    Parameters
    ----------
    wavelength_um
        In vacuum. [µm]
    permittivity
        Of the wires. [1]

    Returns
    -------
    ``*_transmittance`` is power through the output port over the same with grid, plate and substrate
    removed, Eq. (7). ``*_reflectance`` and ``*_absorptance`` are shares of the power that comes in through
    the input port, and ``free_transmittance`` is the share that crosses the space with all removed, so that
    transmittance × free_transmittance + reflectance + absorptance is at most 1; the rest leaves through the
    sides. ``field_ratio_*`` is the pass over the block amplitude of the wave that leaves straight on,
    ``coherence_*`` the power of interference of both polarizations over the removed run's power. [1]
    """
    order = pixel.design.fem.order_at(wavelength_um)
    free = solve(pixel.free, wavelength_um, "pass", 1.0, order)
    passed = solve(pixel.grid, wavelength_um, "pass", permittivity, order)
    blocked = solve(pixel.grid, wavelength_um, "block", permittivity, order)
    removed, incident = free.output.power(), free.input.power()
    row = {"free_transmittance": removed / incident}
    for name, solution in (("pass", passed), ("block", blocked)):
        row[f"{name}_transmittance"] = solution.output.power() / removed
        # the scattered field alone travels back; the source's own wave cancels in the difference
        row[f"{name}_reflectance"] = -(solution.input - free.input).power() / incident
        row[f"{name}_absorptance"] = solution.absorbed_um / incident
    ratio = passed.output.mean_electric() / blocked.output.mean_electric()
    coherence = passed.output.interference_power(blocked.output) / removed
    row |= {"field_ratio_real": ratio.real, "field_ratio_imag": ratio.imag}
    row |= {"coherence_real": coherence.real, "coherence_imag": coherence.imag}
    if not np.isfinite(list(row.values())).all():
        raise ValueError(f"`fem` must give finite fields; got none at {wavelength_um:g} µm. Refine the mesh.")
    return row


def field_maps(design: WireGridDesign, wavelength_um: float, step_um: float = 0.05) -> xr.Dataset:
    """Fields and energy density over the modelled space for both polarizations, incident amplitude 1.

    Parameters
    ----------
    wavelength_um
        In vacuum. [µm]
    step_um
        Spacing of the map's points. [µm]

    Returns
    -------
    Over ``z`` (along the light, 0 where the wires begin) and ``x`` (across the wires), both in µm:
    ``electric_across`` and ``electric_along``, the snapshot Re E of the transverse field where E is across
    and along the wires; ``electric_across_quadrature`` and ``electric_along_quadrature``, Im E, which is the
    snapshot a quarter period later; ``energy_across`` and ``energy_along``, the time-averaged energy density
    (½(|ε||E|² + |H|²)) over the incident wave's. NaN in the plate. [1]
    """
    space = grid_space(design, wavelength_um)
    eps = complex(permittivity(design.metal, wavelength_um))
    order, k = design.fem.order_at(wavelength_um), 2 * np.pi / wavelength_um
    half_x, thick = design.port_um / 2, design.wire_height_nm * 1e-3
    # cell centres: no point is on the drawing's own lines
    x = step_um * (np.arange(round(half_x / step_um)) + 0.5)
    z = step_um * (np.arange(round(design.depth_um / step_um)) + 0.5) - design.depth_um / 2
    grid_z, grid_x = np.meshgrid(z, x, indexing="ij")
    plate = (grid_x > design.aperture_um / 2) & (grid_z > 0) & (grid_z < thick)
    points = space.mesh(grid_x[~plate], grid_z[~plate])
    local = permittivity_map(space, eps)(points).ravel()
    variables = {}
    polarizations: dict[str, Polarization] = {"across": "pass", "along": "block"}
    for name, polarization in polarizations.items():
        field = solve(space, wavelength_um, polarization, eps, order).field
        u, slope = field(points).ravel(), ng.grad(field)(points)
        if polarization == "pass":
            electric = slope[:, 1] / (1j * k * local)
            strength = (abs(slope) ** 2).sum(axis=1) / (k * abs(local)) ** 2
            energy = 0.5 * (abs(local) * strength + abs(u) ** 2)
        else:
            electric = u
            energy = 0.5 * (abs(local) * abs(u) ** 2 + (abs(slope) ** 2).sum(axis=1) / k**2)
        maps = {"electric_{}": electric.real, "electric_{}_quadrature": electric.imag, "energy_{}": energy}
        for key, values in maps.items():
            half = np.full(plate.shape, np.nan)
            half[~plate] = values
            full = np.concatenate([half[:, ::-1], half], axis=1)  # every mapped quantity is even in x
            variables[key.format(name)] = (("z", "x"), full, {"units": "1"})
    return xr.Dataset(
        variables,
        coords={"z": ("z", z, {"units": "um"}), "x": ("x", np.r_[-x[::-1], x], {"units": "um"})},
        attrs={"wavelength_um": wavelength_um, "design": design.model_dump_json()},
    )


def main() -> None:
    """Answer requests until standard input ends."""
    design = WireGridDesign.model_validate_json(sys.stdin.readline())
    pixel, sizes = None, ()
    for line in sys.stdin:
        wavelength_um, real, imaginary = json.loads(line)
        needed = design.fem.air_element_at(wavelength_um), design.fem.wire_element_at(wavelength_um)
        if pixel is None or sizes != needed:
            pixel, sizes = Pixel.of(design, wavelength_um), needed
        row = measure(pixel, wavelength_um, complex(real, imaginary))
        about = {"ngsolve": version("ngsolve"), "elements": pixel.grid.mesh.ne}
        print(json.dumps({"wavelength_um": wavelength_um, **row, **about}), flush=True)


if __name__ == "__main__":
    main()
