"""Dynamics of a micromirror: modes at rest, the squeezed air film, the response to a step; and its table."""

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from glintrack.core.arrays import Array
from glintrack.core.spectral import wavelength_grid
from glintrack.devices.micromirror.equilibrium import (
    MicromirrorDesign,
    dynamic_pull_in_voltage,
    equilibrium,
    forces,
    lever_arms,
    pull_in,
    steepest_tilt,
    stiffness_matrix,
)
from glintrack.devices.micromirror.plate import bend_plate
from glintrack.devices.micromirror.scatter import relay_throughput, scatter, wing_fraction

AIR_VISCOSITY_PA_S = 1.82e-5  # 20 °C; Kadoya et al., J. Phys. Chem. Ref. Data 14, 947 (1985)
AIR_MEAN_FREE_PATH_M = 66e-9  # 20 °C, 1 atm; Jennings, J. Aerosol Sci. 19, 159 (1988)
_SERIES = 200  # terms of the film's double series; the last ones add under 1e-6
_SAMPLES_PER_PERIOD = 40
_TIME_CONSTANTS = 8  # e^−8: a step is over
_CLOSED = 0.02  # of the gap left: the plate has touched down


@dataclass(frozen=True)
class PlateModes:
    """Small motions about a rest position.

    Parameters
    ----------
    frequency_hz
        Undamped, rising. [Hz]
    damping_ratio
        Of each mode, 1 at critical damping. [1]
    """

    frequency_hz: Float[Array, "3"]
    damping_ratio: Float[Array, "3"]


def inertia(design: MicromirrorDesign) -> Float[Array, "3"]:
    """Mass of plate and film, and its two moments of inertia. [kg, kg m², kg m²]"""
    p = design.plate
    areal = (p.density_kg_m3 * p.thickness_nm + p.film_density_kg_m3 * p.film_thickness_nm) * 1e-9
    mass = areal * p.side_m**2
    return np.array([mass, mass * p.side_m**2 / 12, mass * p.side_m**2 / 12])


def air_film(design: MicromirrorDesign, gap_m: float) -> Float[Array, "3"]:
    """Drag of the air squeezed between plate and ground, in piston, tip and tilt. [N s/m, N m s, N m s]

    Incompressible Reynolds film between squares with open edges, with the effective viscosity of a thin film.

    References
    ----------
    Bao and Yang, Sensors and Actuators A 136, 3 (2007): 0.42 μ a⁴/h³ for a square plate. Veijola et al.,
    Sensors and Actuators A 48, 239 (1995), for the viscosity.
    """
    side = design.plate.side_m
    viscosity = AIR_VISCOSITY_PA_S / (1 + 9.638 * (AIR_MEAN_FREE_PATH_M / gap_m) ** 1.159)
    flat, tipped = square_film()
    unit = viscosity * side**4 / gap_m**3
    return unit * np.array([flat, tipped * side**2, tipped * side**2])


def square_film() -> tuple[float, float]:
    """Drag coefficients of a square film: force/(μ a⁴/h³ · speed) and moment/(μ a⁶/h³ · rate). [1]"""
    m = np.arange(1, _SERIES)
    even_part = np.where(m % 2, 2 / (m * np.pi), 0.0)  # ∫ sin(mπx) dx over 0 to 1
    odd_part = np.where(m % 2, 0.0, -1 / (m * np.pi))  # ∫ (x − ½) sin(mπx) dx
    laplacian = np.pi**2 * (m[:, None] ** 2 + m[None, :] ** 2)
    flat = np.sum(np.outer(even_part, even_part) ** 2 / laplacian)
    tipped = np.sum(np.outer(odd_part, even_part) ** 2 / laplacian)
    return float(12 * 4 * flat), float(12 * 4 * tipped)  # 4: norm of the sines


def modes(design: MicromirrorDesign, voltages_v: tuple[float, float, float] | None = None) -> PlateModes:
    """Mode frequencies and damping about the rest position under voltage.

    Raises
    ------
    ValueError
        Beyond pull-in.
    """
    voltages = np.asarray(design.drive.voltages_v if voltages_v is None else voltages_v, float)
    rest = equilibrium(design, tuple(voltages))
    unit = np.array([1.0, *2 * [1 / design.actuator.spring_radius_m]])
    mass, q = np.diag(inertia(design) * unit**2), np.array([rest.piston_m, rest.tip_rad, rest.tilt_rad])
    squared, shape = eigh(stiffness_matrix(design, voltages, q), mass)
    omega = np.sqrt(squared)
    if design.actuator.quality_factor is None:
        drag = air_film(design, design.actuator.gap_m - rest.piston_m) * unit**2
        ratio = drag @ shape**2 / (2 * omega)
    else:
        ratio = np.full(3, 0.5 / design.actuator.quality_factor)
    return PlateModes(omega / (2 * np.pi), ratio)


def step_response(
    design: MicromirrorDesign,
    voltages_v: tuple[float, float, float] | None = None,
    start_v: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> xr.Dataset:
    """Motion after the voltages jump.

    Parameters
    ----------
    voltages_v
        After the jump; the design's by default. [V]
    start_v
        Before it. [V]

    Returns
    -------
    ``piston`` [m], ``tip``, ``tilt`` [rad] over ``time`` [s]; attributes ``settling_time_s`` (NaN where the
    overshoot pulls the plate in), ``overshoot`` (largest travel beyond the rest position over the step, at
    any electrode), ``settles_within_frame`` and ``pulled_in`` (1 or 0).

    Raises
    ------
    ValueError
        If the voltages before or after are beyond the static pull-in.
    """
    target = np.asarray(design.drive.voltages_v if voltages_v is None else voltages_v, float)
    before, after = equilibrium(design, start_v), equilibrium(design, tuple(target))
    about = modes(design, tuple(target))
    decay = 2 * np.pi * about.frequency_hz * about.damping_ratio
    slow = np.where(about.damping_ratio > 1, decay / (2 * about.damping_ratio**2), decay)
    duration = min(_TIME_CONSTANTS / slow.min(), design.drive.frame_time_ms * 1e-3)
    samples = int(np.clip(duration * about.frequency_hz.max() * _SAMPLES_PER_PERIOD, 400, 200_000))
    gap = design.actuator.gap_m
    springs, electrodes = lever_arms(design)
    motion = _equation_of_motion(design, target, springs, electrodes)

    def touches(_t: float, state: Array) -> float:
        return gap * (1 - _CLOSED) - (electrodes @ state[:3]).max()

    touches.terminal = True  # pyright: ignore[reportFunctionMemberAccess] - solve_ivp reads it
    start = np.r_[before.piston_m, before.tip_rad, before.tilt_rad, 0, 0, 0]
    smallest = np.r_[1e-6 * gap, 2 * [1e-6], 1e-6 * gap * 1e5, 2 * [0.1]]
    longest = 0.25 / about.frequency_hz.max()  # at rest longer steps would swing up
    solved = solve_ivp(
        motion, (0.0, duration), start, "DOP853", np.linspace(0, duration, samples), events=touches,
        max_step=longest, rtol=1e-7, atol=1e-3 * smallest,
    )  # fmt: skip
    attrs = {"settling_time_s": float("nan"), "overshoot": float("nan"), "settles_within_frame": 0}
    attrs["pulled_in"] = int(solved.status == 1)
    if not attrs["pulled_in"]:
        attrs |= _settling(design, solved.t, electrodes @ solved.y[:3], before.travel_m, after.travel_m)
    return xr.Dataset(
        {
            name: ("time", solved.y[k], {"units": units})
            for k, (name, units) in enumerate({"piston": "m", "tip": "rad", "tilt": "rad"}.items())
        },
        coords={"time": ("time", solved.t, {"units": "s"})},
        attrs={**attrs, "voltages_v": list(target), "start_v": list(start_v)},
    )


def _equation_of_motion(design: MicromirrorDesign, voltages: Array, springs: Array, electrodes: Array):
    mass, gap = inertia(design), design.actuator.gap_m
    spring_matrix = design.actuator.spring_n_per_m * springs.T @ springs
    quality = design.actuator.quality_factor
    fixed = None if quality is None else np.sqrt(np.diag(spring_matrix) * mass) / quality
    open_film = air_film(design, gap)

    def motion(_t: float, state: Array) -> Array:
        q, speed = state[:3], state[3:]
        travel = np.minimum(electrodes @ q, gap * (1 - 0.5 * _CLOSED))  # the solver may look past touch-down
        drag = open_film * (gap / (gap - travel.mean())) ** 3 if fixed is None else fixed
        force = electrodes.T @ forces(design, voltages, travel) - spring_matrix @ q - drag * speed
        return np.r_[speed, force / mass]

    return motion


def _settling(
    design: MicromirrorDesign, time: Array, travel: Array, before: Array, after: Array
) -> dict[str, float]:
    """Settling time, overshoot and whether the plate settles, as attributes of `step_response`."""
    step = np.abs(after - before).max()
    if step == 0:
        return {"settling_time_s": 0.0, "overshoot": 0.0, "settles_within_frame": 1}
    away = np.abs(travel - after[:, None]).max(axis=0) > design.drive.settled_share * step
    last = int(np.flatnonzero(away).max(initial=0))
    settled = last + 1 < time.size
    toward = np.sign(after - before)[:, None]
    return {
        "settling_time_s": float(time[last + 1]) if settled else float("nan"),
        "overshoot": max(float((toward * (travel - after[:, None])).max() / step), 0.0),
        "settles_within_frame": int(settled),
    }


def tabulate(design: MicromirrorDesign, f_number: float = 5.6) -> xr.Dataset:
    """Rest position, travel, modes, step response and scatter of a micromirror; bow and heat with scikit-fem.

    Raises
    ------
    ValueError
        Beyond pull-in, with the limit.
    """
    rest, limit = equilibrium(design), pull_in(design)
    volts = np.linspace(0, limit.max(), 200)
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
    return table.merge(bend_plate(design), combine_attrs="no_conflicts")
