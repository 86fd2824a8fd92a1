"""Design of a pixel-sized wire-grid polarizer: the cross-section of §3.1, its metal, its finite elements."""

import math
from typing import Self

from pydantic import Field, model_validator

from glintrack.core.designs import Design
from glintrack.core.installation import read_data
from glintrack.devices.optical_constants import MetalDesign

_LONG_WAVES_UM = 0.8  # from here on fewer and simpler elements reach the same accuracy


class FemDesign(Design):
    """Accuracy of the finite elements; the ``[fem]`` table of a grid's design."""

    order: int | None = Field(default=None, ge=1, le=10)
    """Polynomial order [default: 5 below 0.8 µm, 4 above]."""
    wire_element_nm: float | None = Field(default=None, ge=0.5, le=200)
    """Longest edge in a wire [default: 10 below 0.8 µm, 14 above]."""
    air_element_um: float | None = Field(default=None, ge=0.02, le=1)
    """Longest edge elsewhere [default: 0.2 below 0.8 µm, 0.3 above]."""

    def order_at(self, wavelength_um: float) -> int:
        """Polynomial order at a wavelength: short waves need the higher one."""
        return self.order or (5 if wavelength_um < _LONG_WAVES_UM else 4)

    def wire_element_at(self, wavelength_um: float) -> float:
        """Longest edge in a wire. [µm]"""
        return 1e-3 * (self.wire_element_nm or (10 if wavelength_um < _LONG_WAVES_UM else 14))

    def air_element_at(self, wavelength_um: float) -> float:
        """Longest edge outside the wires. [µm]"""
        return self.air_element_um or (0.2 if wavelength_um < _LONG_WAVES_UM else 0.3)


class WireGridDesign(Design):
    """A grid of parallel wires in the aperture of a solid, perfectly conducting plate, lit from the air side.

    The default is the paper's grid A. The model is two-dimensional: wires and aperture go on along the wires.
    """

    period_nm: float = Field(default=500.0, gt=0, le=5000, description="Spacing d of the wires")
    wire_width_nm: float = Field(default=100.0, gt=0, le=5000, description="At half the wire's height")
    wire_height_nm: float = Field(default=100.0, gt=0, le=2000)
    """Of wires and plate, along the light."""
    wall_angle_deg: float = Field(default=90.0, gt=30, le=90)
    """Of the wires' walls from the substrate; below 90 a wire is widest on the substrate."""
    wires: int = Field(default=20, ge=1, le=2000, description="How many, centred in the aperture")
    aperture_um: float = Field(default=10.0, gt=0, le=50, description="Opening in the plate")
    substrate_index: float = Field(default=1.0, ge=1, le=4)
    """Refractive index of the half space behind the wires; 1 is air."""
    port_um: float = Field(default=15.0, gt=0, le=100, description="Width of the modelled space")
    depth_um: float = Field(default=10.0, gt=0, le=50, description="Of the modelled space, along the light")
    pml_um: float = Field(default=1.0, gt=0, le=5, description="Perfectly matched layer around it")
    metal: MetalDesign = MetalDesign()
    fem: FemDesign = FemDesign()

    @model_validator(mode="after")
    def _wires_fit(self) -> Self:
        base, top = self.base_width_um * 1e3, self.top_width_um * 1e3
        if base >= self.period_nm:
            raise ValueError(
                f"`wire_width_nm` must leave a gap: the wires' base must be narrower than the period of "
                f"{self.period_nm:g} nm; got {base:g} nm."
            )
        if top <= 0:
            raise ValueError(
                f"`wall_angle_deg` must leave the wires a top at {self.wire_height_nm:g} nm; "
                f"got {self.wall_angle_deg:g}."
            )
        needed_um = (self.wires - 1) * self.period_nm * 1e-3 + self.base_width_um
        if needed_um > self.aperture_um * (1 + 1e-9):
            raise ValueError(
                f"`aperture_um` must hold the {self.wires} wires, which need at least {needed_um:g} µm; "
                f"got {self.aperture_um:g} µm."
            )
        if self.aperture_um >= self.port_um:
            raise ValueError(
                f"`port_um` must be wider than the aperture of {self.aperture_um:g} µm; got {self.port_um:g}."
            )
        if self.wire_height_nm * 1e-3 >= self.depth_um / 4:
            raise ValueError(
                f"`depth_um` must be more than four times the wires' height of {self.wire_height_nm:g} nm; "
                f"got {self.depth_um:g} µm."
            )
        return self

    @property
    def _flare_um(self) -> float:
        """Excess of the base's width over the middle's."""
        return self.wire_height_nm * 1e-3 / math.tan(math.radians(self.wall_angle_deg))

    @property
    def base_width_um(self) -> float:
        """Width of a wire on the substrate. [µm]"""
        return self.wire_width_nm * 1e-3 + max(self._flare_um, 0.0)

    @property
    def top_width_um(self) -> float:
        """Width of a wire on the side of the light. [µm]"""
        return self.wire_width_nm * 1e-3 - max(self._flare_um, 0.0)


PAPER_GRIDS = {
    name: WireGridDesign(**keys) for name, keys in read_data("devices", "wire_grid.toml")["grids"].items()
}
