"""A micromirror over three electrodes: design, equilibrium in piston, tip and tilt, pull-in.

The plate is rigid here and hangs on three springs; `plate` bends it. Piston is counted toward the
electrodes, tip and tilt are the slopes of the plate along +x and +y in the same sense. Electrodes and springs
are at 90°, 210° and 330°, counter-clockwise from +x; each electrode's force is that of a parallel-plate
capacitor with the gap at its middle.
"""

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator
from scipy.constants import epsilon_0

from glintrack.core.arrays import Array
from glintrack.core.designs import Design

ELECTRODE_ANGLES_RAD = np.radians([90.0, 210.0, 330.0])
_NEWTON_STEPS = 200  # next to pull-in Newton's method halves its error a step: 40 do for double precision


class ActuatorDesign(Design):
    """Springs and electrodes; the ``[actuator]`` table of a micromirror."""

    spring_n_per_m: float = Field(default=0.35, gt=0, le=1e4, description="Stiffness of each spring")
    spring_radius_um: float = Field(default=4.0, gt=0, le=1000)
    """Of the circle on which the springs hold the plate."""
    leg_radius_um: float = Field(default=1.0, gt=0, le=1000)
    """Of the spot where a spring joins the plate."""
    electrode_area_um2: float = Field(default=30.0, gt=0, le=1e6, description="Area of each electrode")
    electrode_radius_um: float = Field(default=4.0, gt=0, le=1000)
    """Of the circle on which the electrodes' centres lie."""
    electrode_gap_um: float = Field(default=1.5, gt=0.01, le=100)
    """Plate to electrodes without voltage."""
    quality_factor: float | None = Field(default=None, gt=0.05, le=1e6)
    """Of every mode [default: squeezed air film]."""

    gap_m = property(lambda self: self.electrode_gap_um * 1e-6)
    electrode_area_m2 = property(lambda self: self.electrode_area_um2 * 1e-12)
    spring_radius_m = property(lambda self: self.spring_radius_um * 1e-6)
    electrode_radius_m = property(lambda self: self.electrode_radius_um * 1e-6)


class PlateDesign(Design):
    """The square plate; the ``[plate]`` table. Defaults: sputtered aluminium under a silver film."""

    side_um: float = Field(default=16.0, gt=0.1, le=2000, description="Side of the square plate")
    thickness_nm: float = Field(default=500.0, gt=1, le=1e5, description="Of the plate without its film")
    youngs_modulus_gpa: float = Field(default=70.0, gt=0, le=2000)
    poisson_ratio: float = Field(default=0.35, ge=0, lt=0.5)
    density_kg_m3: float = Field(default=2700.0, gt=0, le=30000)
    expansion_per_mk: float = Field(default=23.1, ge=-100, le=1000)
    """Linear expansion per million kelvin, i.e. in 10⁻⁶ K⁻¹."""
    conductivity_w_m_k: float = Field(default=237.0, gt=0, le=5000, description="Of heat")
    resistivity_nohm_m: float = Field(default=28.1, gt=0, le=1e12, description="Electrical, not heated")
    resistivity_growth_per_k: float = Field(default=0.0039, ge=0, le=1)
    """Relative growth of the resistivity with temperature."""
    film_thickness_nm: float = Field(default=30.0, ge=0, le=1e5, description="Of the mirror film on top")
    film_youngs_modulus_gpa: float = Field(default=83.0, gt=0, le=2000)
    film_poisson_ratio: float = Field(default=0.37, ge=0, lt=0.5)
    film_density_kg_m3: float = Field(default=10490.0, gt=0, le=30000)
    film_expansion_per_mk: float = Field(default=18.9, ge=-100, le=1000, description="In 10⁻⁶ K⁻¹")
    film_stress_mpa: float = Field(default=0.0, ge=-5000, le=5000)
    """Built in, tension positive, before the plate bends."""

    side_m = property(lambda self: self.side_um * 1e-6)


class SurfaceDesign(Design):
    """The mirror's surface; the ``[surface]`` table."""

    roughness_nm: float = Field(default=1.0, ge=0, le=200, description="RMS height, spatial periods > λ")
    correlation_length_um: float = Field(default=2.0, gt=0, le=1000, description="Of the height")
    rolloff: float = Field(default=2.0, gt=1, le=6)
    """Log-log slope of the scatter beyond its shoulder, the g of ABg."""
    reflectance: float = Field(default=0.96, ge=0, le=1, description="Share of light that is not absorbed")


_Voltage = Annotated[float, Field(ge=-1e4, le=1e4)]


class DriveDesign(Design):
    """Voltages, current and light on the mirror; the ``[drive]`` table."""

    voltages_v: tuple[_Voltage, _Voltage, _Voltage] = (25.0, 25.0, 25.0)
    """On the electrodes at 90°, 210° and 330°."""
    current_ma: float = Field(default=0.0, ge=0, le=1000, description="Into spring 1, out of 2 and 3")
    irradiance_w_m2: float = Field(default=100.0, ge=0, le=1e8, description="Of all light on the plate")
    leg_conductance_uw_k: float = Field(default=2.0, gt=0, le=1e6)
    """Heat that each spring carries per kelvin."""
    air_conductivity_w_m_k: float = Field(default=0.026, ge=0, le=10)
    """Of the gas in the gap; 0 for vacuum."""
    frame_time_ms: float = Field(default=100.0, gt=0, le=1e5, description="In which the mirror must settle")
    settled_share: float = Field(default=0.02, gt=0, lt=1)
    """Of the step that may be left when it counts as settled."""


class MicromirrorDesign(Design):
    """One micromirror: what ``glintrack device micromirror`` reads."""

    name: str = Field(default="micromirror", min_length=1, max_length=80)
    actuator: ActuatorDesign = ActuatorDesign()
    plate: PlateDesign = PlateDesign()
    surface: SurfaceDesign = SurfaceDesign()
    drive: DriveDesign = DriveDesign()

    @model_validator(mode="after")
    def _all_under_the_plate(self) -> Self:
        a, half = self.actuator, self.plate.side_um / 2
        for name, more in (
            ("electrode_radius_um", np.sqrt(a.electrode_area_um2 / np.pi)),
            ("spring_radius_um", 0.0),
        ):
            if getattr(a, name) + more > half:
                raise ValueError(
                    f"`actuator.{name}` must be at most {half - more:.4g} µm, to keep under a plate of "
                    f"{self.plate.side_um:g} µm; got {getattr(a, name):g}."
                )
        return self


@dataclass(frozen=True)
class Equilibrium:
    """Rest position of a rigid plate.

    Parameters
    ----------
    piston_m, tip_rad, tilt_rad
        Toward the electrodes; slope along +x; slope along +y. [m, rad, rad]
    travel_m
        Of the plate above each electrode's middle, toward it. [m]
    margin
        Lowest eigenvalue of the stiffness with voltage over that without: 1 at rest, 0 at pull-in. [1]
    """

    piston_m: float
    tip_rad: float
    tilt_rad: float
    travel_m: Float[Array, "3"]
    margin: float


def pull_in_voltage(spring_n_per_m: float, area_m2: float, gap_m: float) -> float:
    """Voltage at which a parallel-plate actuator snaps in, at a third of its gap: √(8kg³/(27ε₀A)). [V]"""
    return float(np.sqrt(8 * spring_n_per_m * gap_m**3 / (27 * epsilon_0 * area_m2)))


def holding_voltage(
    travel_m: Float[Array, "*shape"], spring_n_per_m: float, area_m2: float, gap_m: float
) -> Float[Array, "*shape"]:
    """Voltage of a parallel-plate actuator at a travel: √(2kx(g−x)²/(ε₀A)). [V]

    Parameters
    ----------
    travel_m
        0 to a third of the gap; beyond it the plate is pulled in. [m]

    Raises
    ------
    ValueError
        Beyond a third of the gap, with the limit.
    """
    x = np.asarray(travel_m, dtype=float)
    if x.size and (x.min() < 0 or x.max() > gap_m / 3 * (1 + 1e-12)):
        worst = x.max() if x.max() > gap_m / 3 else x.min()
        raise ValueError(
            f"`travel` must lie within 0 to {gap_m / 3 * 1e9:.4g} nm, a third of the electrode gap of "
            f"{gap_m * 1e9:.4g} nm; got {worst * 1e9:.4g} nm. Beyond it the plate is pulled in."
        )
    return np.sqrt(2 * spring_n_per_m * x * (gap_m - x) ** 2 / (epsilon_0 * area_m2))


def equilibrium(
    design: MicromirrorDesign, voltages_v: tuple[float, float, float] | None = None
) -> Equilibrium:
    """Rest position of the plate under three voltages, reached from rest by raising them slowly.

    Parameters
    ----------
    voltages_v
        On the electrodes at 90°, 210° and 330°; the design's by default. [V]

    Raises
    ------
    ValueError
        Beyond pull-in, with the limit for these voltages' proportions.
    """
    voltages = np.asarray(design.drive.voltages_v if voltages_v is None else voltages_v, float)
    found = _rest(design, voltages)
    if found is None:
        limit = pull_in(design, tuple(voltages))
        raise ValueError(
            f"`drive.voltages_v` must stay below pull-in at {_in_volts(limit)} V; "
            f"got {_in_volts(voltages)} V."
        )
    return found


def pull_in(
    design: MicromirrorDesign, pattern: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Float[Array, "3"]:
    """Voltages in the proportions of ``pattern`` at which the plate is pulled in. [V]"""
    pattern_v = np.abs(np.asarray(pattern, float))
    if not pattern_v.max() > 0:
        raise ValueError("`pattern` must have a voltage other than 0; got none.")
    a = design.actuator
    high = pull_in_voltage(a.spring_n_per_m, a.electrode_area_m2, a.gap_m)
    pattern_v = pattern_v / pattern_v.max()
    while _rest(design, high * pattern_v) is not None:
        high *= 2
    low = 0.0
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _rest(design, middle * pattern_v) is None else (middle, high)
    return low * pattern_v


def steepest_tilt(design: MicromirrorDesign) -> tuple[float, float]:
    """Largest tilt toward the first electrode that it can hold alone, and its voltage. [rad, V]"""
    volts = pull_in(design, (1.0, 0.0, 0.0))[0]
    rest = _rest(design, np.array([volts, 0.0, 0.0]) * (1 - 1e-9))
    return (rest.tilt_rad, float(volts)) if rest else (0.0, 0.0)


def dynamic_pull_in_voltage(design: MicromirrorDesign) -> float:
    """Sudden voltage on all electrodes that pulls an undamped plate in by overshoot: √(kg³/(4ε₀A)). [V]

    Its energy barrier vanishes there; the slow limit is 9 % higher.
    """
    a = design.actuator
    return float(np.sqrt(a.spring_n_per_m * a.gap_m**3 / (4 * epsilon_0 * a.electrode_area_m2)))


def lever_arms(design: MicromirrorDesign) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
    """Matrices that turn (piston, tip, tilt) into travel at the springs and at the electrodes. [1, m, m]"""
    ones, cosine, sine = np.ones(3), np.cos(ELECTRODE_ANGLES_RAD), np.sin(ELECTRODE_ANGLES_RAD)
    radii = design.actuator.spring_radius_m, design.actuator.electrode_radius_m
    springs, electrodes = (np.column_stack([ones, r * cosine, r * sine]) for r in radii)
    return springs, electrodes


def forces(
    design: MicromirrorDesign, voltages_v: Float[Array, "3"], travel_m: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Pull of each electrode, ε₀AV²/(2(g−x)²). [N]"""
    a = design.actuator
    return epsilon_0 * a.electrode_area_m2 * voltages_v**2 / (2 * (a.gap_m - travel_m) ** 2)


def stiffness_matrix(
    design: MicromirrorDesign, voltages: Float[Array, "3"], q: Float[Array, "3"]
) -> Float[Array, "3 3"]:
    """Springs less electrostatics at (piston, tip, tilt), for (piston, tip·r, tilt·r). [N/m]

    r is the springs' radius.
    """
    a = design.actuator
    springs, electrodes = lever_arms(design)
    unit = np.array([1.0, *2 * [1 / a.spring_radius_m]])
    softening = 2 * forces(design, voltages, electrodes @ q) / (a.gap_m - electrodes @ q)
    springs, electrodes = springs * unit, electrodes * unit
    return a.spring_n_per_m * springs.T @ springs - electrodes.T @ (softening[:, None] * electrodes)


def _rest(design: MicromirrorDesign, voltages: Array) -> Equilibrium | None:
    """Newton's method from rest; None beyond pull-in.

    The force grows ever faster with travel, so that the steps from rest approach the nearest equilibrium from
    one side; where there is none the stiffness loses its sign on the way.
    """
    a = design.actuator
    springs, electrodes = lever_arms(design)
    unit = np.array([1.0, *2 * [1 / a.spring_radius_m]])
    q = np.zeros(3)
    for _ in range(_NEWTON_STEPS):
        stiffness = stiffness_matrix(design, voltages, q)
        if np.linalg.eigvalsh(stiffness)[0] <= 0:
            return None
        pull = (electrodes * unit).T @ forces(design, voltages, electrodes @ q)
        hold = a.spring_n_per_m * (springs * unit).T @ (springs @ q)
        step = unit * np.linalg.solve(stiffness, pull - hold)
        q = q + step
        travel = electrodes @ q
        if travel.max() >= a.gap_m:
            return None
        if np.abs(electrodes @ step).max() < 1e-15 * a.gap_m:
            break
    lowest = np.linalg.eigvalsh(stiffness_matrix(design, voltages, q))[0]
    free = np.linalg.eigvalsh(stiffness_matrix(design, np.zeros(3), np.zeros(3)))[0]
    if lowest <= 0:
        return None
    return Equilibrium(float(q[0]), float(q[1]), float(q[2]), travel, float(lowest / free))


def _in_volts(values: Array) -> str:
    return "[" + ", ".join(f"{v:.4g}" for v in values) + "]"
