"""Response of a meshed pixel to light of one wavelength: boundary irradiance ratios, Eq. (7), and more."""

from dataclasses import dataclass

import numpy as np

from glintrack.devices.wire_grid import fem
from glintrack.devices.wire_grid.design import WireGridDesign


@dataclass(frozen=True)
class Pixel:
    """A design with its two meshes: the grid in its plate, and the space with all removed."""

    design: WireGridDesign
    grid: fem.Space
    free: fem.Space

    @classmethod
    def of(cls, design: WireGridDesign, wavelength_um: float) -> "Pixel":
        """Mesh a design for a wavelength; the same mesh serves all with the same element sizes."""
        return cls(design, fem.grid_space(design, wavelength_um), fem.free_space(design, wavelength_um))


def measure(pixel: Pixel, wavelength_um: float, permittivity: complex) -> dict[str, float]:
    """Solve both polarizations and the removed run.

    Parameters
    ----------
    pixel
        The meshes.
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
    free = fem.solve(pixel.free, wavelength_um, "pass", 1.0, order)
    passed = fem.solve(pixel.grid, wavelength_um, "pass", permittivity, order)
    blocked = fem.solve(pixel.grid, wavelength_um, "block", permittivity, order)
    removed, incident = free.output.power(), free.input.power()
    row = {"free_transmittance": removed / incident}
    for name, solution in (("pass", passed), ("block", blocked)):
        row[f"{name}_transmittance"] = solution.output.power() / removed
        # the scattered field alone travels back; the source's own wave cancels in the difference
        row[f"{name}_reflectance"] = -(solution.input - free.input).power() / incident
        row[f"{name}_absorptance"] = solution.absorbed_um / incident
    ratio = passed.output.mean_electric() / blocked.output.mean_electric()
    coherence = passed.output.shared_power(blocked.output) / removed
    row |= {"field_ratio_real": ratio.real, "field_ratio_imag": ratio.imag}
    row |= {"coherence_real": coherence.real, "coherence_imag": coherence.imag}
    if not np.isfinite(list(row.values())).all():
        raise ValueError(f"`fem` must give finite fields, got none at {wavelength_um:g} µm (refine the mesh)")
    return row
