"""One table of all that is worked out of a micromirror."""

from importlib.util import find_spec

import numpy as np
import xarray as xr

from glintrack.core.spectral import wavelength_grid
from glintrack.devices.micromirror.dynamics import modes, step_response
from glintrack.devices.micromirror.equilibrium import (
    MicromirrorDesign,
    dynamic_pull_in_voltage,
    equilibrium,
    pull_in,
    steepest_tilt,
)
from glintrack.devices.micromirror.plate import bend_plate
from glintrack.devices.micromirror.scatter import relay_throughput, scatter, wing_fraction

_TRAVEL_POINTS = 200


def tabulate(design: MicromirrorDesign, f_number: float = 5.6) -> xr.Dataset:
    """Rest position, travel, modes, step response and scatter of a micromirror; bow and heat with scikit-fem.

    Raises
    ------
    ValueError
        Beyond pull-in, with the limit.
    """
    rest, limit = equilibrium(design), pull_in(design)
    volts = np.linspace(0, limit.max(), _TRAVEL_POINTS)
    piston = [equilibrium(design, (v, v, v)).piston_m for v in volts * (1 - 1e-9)]
    about, wavelength = modes(design), wavelength_grid()
    model = scatter(design.surface, wavelength)
    beyond = wing_fraction(model, 0.5 / f_number)
    relayed = relay_throughput(design, wavelength, f_number)
    table = step_response(design).assign(
        even_voltage=("even_voltage", volts, {"units": "V"}),
        even_piston=("even_voltage", piston, {"units": "m"}),
        mode_frequency=("mode", about.frequency_hz, {"units": "Hz"}),
        mode_damping_ratio=("mode", about.damping_ratio, {"units": "1"}),
        scattered=("wavelength", model.total, {"units": "1"}),
        scattered_beyond_stop=("wavelength", beyond, {"units": "1"}),
        relay_throughput=("wavelength", relayed, {"units": "1"}),
        wavelength=("wavelength", wavelength, {"units": "um"}),
    )
    tilt, volts_alone = steepest_tilt(design)
    table.attrs |= {
        "device": "micromirror",
        "design": design.model_dump_json(),
        "rigid_piston_m": rest.piston_m,
        "rigid_tip_deg": round(float(np.degrees(rest.tip_rad)), 9) + 0.0,  # no minus before a rounded 0
        "rigid_tilt_deg": float(np.degrees(rest.tilt_rad)),
        "stiffness_margin": rest.margin,
        "pull_in_v": float(limit.max()),
        "dynamic_pull_in_v": dynamic_pull_in_voltage(design),
        "steepest_tilt_deg": float(np.degrees(tilt)),
        "steepest_tilt_v": volts_alone,
    }
    if find_spec("skfem") is None:
        return table
    plate = bend_plate(design)
    return table.assign({name: plate[name] for name in plate.data_vars}).assign_attrs(
        {name: value for name, value in plate.attrs.items() if name != "voltages_v"}
    )
