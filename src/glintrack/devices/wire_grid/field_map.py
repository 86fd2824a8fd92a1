"""Maps of the field in a pixel's cross-section, the paper's Figures 5 and 10."""

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.devices.optical_constants import permittivity
from glintrack.devices.wire_grid import fem
from glintrack.devices.wire_grid.design import WireGridDesign


def field_maps(design: WireGridDesign, wavelength_um: float, step_um: float = 0.05) -> xr.Dataset:
    """Fields and energy density over the modelled space for both polarizations, incident amplitude 1.

    Parameters
    ----------
    design
        The pixel.
    wavelength_um
        In vacuum. [µm]
    step_um
        Spacing of the map's points. [µm]

    Returns
    -------
    Over ``z`` (along the light, 0 where the wires begin) and ``x`` (across the wires), both in µm:
    ``electric_across`` and ``electric_along``, the snapshot Re E of the transverse field where E lies across
    and along the wires; ``electric_across_quadrature`` and ``electric_along_quadrature``, Im E, which is the
    snapshot a quarter period later; ``energy_across`` and ``energy_along``, the time-averaged energy density
    (½(|ε||E|² + |H|²)) over the incident wave's. NaN in the plate. [1]
    """
    space = fem.grid_space(design, wavelength_um)
    eps = complex(permittivity(design.metal, wavelength_um))
    order, k = design.fem.order_at(wavelength_um), 2 * np.pi / wavelength_um
    half_x, thick = design.port_um / 2, design.wire_height_nm * 1e-3
    # cell centres: no point lies on the drawing's own lines
    x = step_um * (np.arange(round(half_x / step_um)) + 0.5)
    z = step_um * (np.arange(round(design.depth_um / step_um)) + 0.5) - design.depth_um / 2
    grid_z, grid_x = np.meshgrid(z, x, indexing="ij")
    plate = (grid_x > design.aperture_um / 2) & (grid_z > 0) & (grid_z < thick)
    points = space.mesh(grid_x[~plate], grid_z[~plate])
    local = fem.permittivity_map(space, eps)(points).ravel()
    variables = {}
    polarizations: tuple[tuple[str, fem.Polarization], ...] = (("across", "pass"), ("along", "block"))
    for name, polarization in polarizations:
        field = fem.solve(space, wavelength_um, polarization, eps, order).field
        u, slope = field(points).ravel(), fem.ng.grad(field)(points)
        if polarization == "pass":
            electric = slope[:, 1] / (1j * k * local)
            strength = (abs(slope) ** 2).sum(axis=1) / (k * abs(local)) ** 2
            energy = 0.5 * (abs(local) * strength + abs(u) ** 2)
        else:
            electric = u
            energy = 0.5 * (abs(local) * abs(u) ** 2 + (abs(slope) ** 2).sum(axis=1) / k**2)
        for key, values in (("", electric.real), ("_quadrature", electric.imag)):
            variables[f"electric_{name}{key}"] = _mirrored(values, plate)
        variables[f"energy_{name}"] = _mirrored(energy, plate)
    return xr.Dataset(
        {key: (("z", "x"), values, {"units": "1"}) for key, values in variables.items()},
        coords={
            "z": ("z", z, {"units": "um"}),
            "x": ("x", np.r_[-x[::-1], x], {"units": "um"}),
        },
        attrs={"wavelength_um": wavelength_um, "design": design.model_dump_json()},
    )


def _mirrored(values: Float[Array, "point"], plate: Array) -> Float[Array, "z x"]:
    """The map over both halves; every mapped quantity is even in x."""
    full = np.full(plate.shape, np.nan)
    full[~plate] = values
    return np.concatenate([full[:, ::-1], full], axis=1)
