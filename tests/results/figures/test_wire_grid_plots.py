"""Pictures of wire grids."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from glintrack.devices import wire_grid
from glintrack.results.figures import devices as plot_devices


def test_overview_draws_a_line_an_angle():
    figure = Figure()
    plot_devices.wire_grid_overview(figure, wire_grid.load("grid_a"))
    transmission, extinction, diattenuation, falloff = figure.axes[:4]
    assert len(transmission.lines) == 10 and len(falloff.lines) == 212  # 211 wavelengths and the ideal
    top, bottom = transmission.lines[0].get_ydata(), transmission.lines[-1].get_ydata()
    assert top[-1] > 0.7 > 0.1 > bottom[-1]  # ψ = 0° passes, 90° does not, at 2.5 µm
    assert len(extinction.lines) == len(diattenuation.lines) == 1


def test_maps_stand_upright():
    """z grows upward, as the light does; the incident side is below."""
    z, x = np.linspace(-1, 1, 8), np.linspace(-2, 2, 16)
    ramp = np.broadcast_to(z[:, None], (8, 16))
    names = ("energy_across", "electric_across", "electric_along")
    maps = xr.Dataset(
        {name: (("z", "x"), ramp) for name in names}, coords={"z": z, "x": x}, attrs={"wavelength_um": 1.5}
    )
    for draw in (plot_devices.cross_section, plot_devices.field_at_angle):
        figure = Figure()
        draw(figure, maps, "ramp")
        (image,) = figure.axes[0].images
        assert image.origin == "lower" and image.get_extent()[2] < image.get_extent()[3]


def test_field_maps_show_a_beam_and_a_shadow():
    pytest.importorskip("ngsolve", reason="the extra em is not installed")
    from glintrack.devices import FemDesign, WireGridDesign

    design = WireGridDesign(
        wires=3,
        aperture_um=1.5,
        port_um=6,
        depth_um=4,
        fem=FemDesign(order=4, wire_element_nm=40, air_element_um=0.25),
    )
    maps = wire_grid.field_maps(design, 0.5)
    assert maps.sizes == {"z": 80, "x": 120}
    behind = maps["energy_across"].sel(z=1.0, method="nearest")
    beam = float(behind.where(abs(behind.x) < 0.5).mean())
    shadow = float(behind.where(abs(behind.x) > 2).mean())
    assert beam > 10 * shadow
    assert np.allclose(maps["electric_along"], maps["electric_along"][:, ::-1], equal_nan=True)
    plate = maps["energy_along"].sel(z=0.05, method="nearest")
    assert np.isnan(plate.where(abs(plate.x) > 0.8, drop=True)).all()
