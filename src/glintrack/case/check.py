"""Derived quantities of a case: sampling of ground and cars, dwell time, and what is unusual about them.

Geometry over level ground at the stare point: the ground sample distance across the line of sight is
pitch × slant range / focal length (Table 1 of the paper), along it that over the off-nadir angle's cosine.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from glintrack.atmosphere import sun_direction
from glintrack.case.design import Case
from glintrack.core.schema import MIN_SCORED_S
from glintrack.core.spectral import quadrature_weights
from glintrack.sensor.layouts import MIRROR, OPEN
from glintrack.sensor.polarizer import load_polarizer
from glintrack.sensor.response import analyser_response, element_response, photon_gain, reference_light

_CAR_M = (4.5, 1.8)
_CITY_SPEED_M_S = 13.9
_WHITE = 0.8  # reflectance of fresh paint and markings
_MAX_FIELD_DEG, _MIN_ELEMENTS, _MIN_FRAMES = 30.0, 2.0, 10.0


@dataclass(frozen=True)
class Feasibility:
    """Derived quantities of a case over level ground.

    Parameters
    ----------
    field_of_view_deg
        Across and down the array. [°]
    gsd_m
        Ground sample distance of an element across and along the line of sight, at the stare point. [m]
    field_m
        Ground in the field of view across and along, at that distance. [m]
    elements_on_car
        Area of a car's plan over that of an element on the ground. [1]
    dwell_s, dwell_frames
        Time in which a vehicle at 50 km/h crosses that field, and frames in it. [s, 1]
    well_filled
        Electrons of sunlit white paint over the full-well capacity. [1]
    of_sensor, of_flight
        Sentences on unusual values of the sensor and its view, and of the flight.
    """

    field_of_view_deg: tuple[float, float]
    gsd_m: tuple[float, float]
    field_m: tuple[float, float]
    elements_on_car: float
    dwell_s: float
    dwell_frames: float
    well_filled: float
    of_sensor: tuple[str, ...] = ()
    of_flight: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Quantities as text, one on each line."""
        return [
            f"field of view        {self.field_of_view_deg[0]:.3g}° × {self.field_of_view_deg[1]:.3g}°",
            f"element on ground    {self.gsd_m[0]:.3g} m across, {self.gsd_m[1]:.3g} m along the view",
            f"field on ground      {self.field_m[0]:.0f} m × {self.field_m[1]:.0f} m",
            f"elements on a car    {self.elements_on_car:.3g}",
            f"dwell at 50 km/h     {self.dwell_s:.3g} s, {self.dwell_frames:.3g} frames",
            f"white paint fills    {100 * self.well_filled:.3g} % of the well",
        ]


def ground_view(case: Case) -> tuple[tuple[float, float], tuple[float, float]]:
    """Ground sample distance and field of view on flat ground at the stare point, across and along. [m]

    A flight along waypoints counts with the altitude and off-nadir angle of ``[flight]``.
    """
    sensor, off_nadir = case.sensor, math.radians(case.flight.off_nadir_deg)
    slant_m = case.flight.altitude_m / math.cos(off_nadir)
    across_m = sensor.ifov_rad * slant_m
    along_m = across_m / math.cos(off_nadir)
    return (across_m, along_m), (sensor.columns * across_m, sensor.rows * along_m)


def assess(case: Case) -> Feasibility:
    """Derive the quantities of a case over level ground, from its keys alone (see `ground_view`)."""
    sensor, flight = case.sensor, case.flight
    (across_m, along_m), field_m = ground_view(case)
    dwell_s = field_m[0] / _CITY_SPEED_M_S
    figures = Feasibility(
        field_of_view_deg=sensor.field_of_view_deg,
        gsd_m=(across_m, along_m),
        field_m=field_m,
        elements_on_car=_CAR_M[0] * _CAR_M[1] / (across_m * along_m),
        dwell_s=dwell_s,
        dwell_frames=dwell_s * flight.rate_hz,
        well_filled=_well_filling(case),
    )
    of_sensor, of_flight = tuple(_sensor_notes(case, figures)), tuple(_flight_notes(case, figures))
    return replace(figures, of_sensor=of_sensor, of_flight=of_flight)


def _well_filling(case: Case) -> float:
    """Electrons of level white paint in AM1.5G light at the sun's height, over the full-well capacity. [1]"""
    um = np.asarray(case.atmosphere.wavelength_um)
    bare = any(what in (OPEN, MIRROR) for row in case.sensor.superpixel for what in row)
    if bare or not case.sensor.has_stokes:
        response = element_response(case.sensor, um)
    else:
        response = analyser_response(case.sensor, load_polarizer(case.sensor), um)[0]
    used = response > 0
    if not used.any():
        return 0.0
    spectrum = reference_light(case.sensor.replace({"reference_spectrum": "am15g"}), um)  # [W m⁻² nm⁻¹]
    cosine = math.cos(sun_direction(case.atmosphere)[0])
    radiance = spectrum * 1e3 * _WHITE * cosine / math.pi  # [W m⁻² sr⁻¹ µm⁻¹]
    weights = quadrature_weights(um) * um * response
    mean = float((weights * radiance).sum() / weights.sum())
    return mean * photon_gain(case.sensor, um, response) / case.sensor.full_well_e


def _sensor_notes(case: Case, of: Feasibility) -> Iterator[str]:
    if max(of.field_of_view_deg) > _MAX_FIELD_DEG:
        yield (
            f"`sensor.focal_length_mm` gives a field of view of {max(of.field_of_view_deg):.0f}°: the ground "
            "sample distance differs much over the frame"
        )
    if of.elements_on_car < _MIN_ELEMENTS:
        yield f"a car covers {of.elements_on_car:.2g} elements of {of.gsd_m[0]:.3g} m × {of.gsd_m[1]:.3g} m"
    if of.well_filled > 1:
        yield (
            f"white paint in the sun fills the well {of.well_filled:.2g} times over: shorten "
            "`sensor.integration_time_ms`"
        )
    if of.well_filled < 0.01:
        yield f"white paint in the sun fills {100 * of.well_filled:.2g} % of the well: noise will show"
    flight, (wide, high) = case.flight, case.scene.size_m
    east, north = abs(flight.stare_east_m) - wide / 2, abs(flight.stare_north_m) - high / 2
    outside_m = math.hypot(max(east, 0.0), max(north, 0.0))
    if not case.scene.uses_mesh_window and outside_m > math.hypot(*of.field_m) / 2:
        yield (
            f"the array looks {outside_m:.0f} m beyond the window of {wide:g} m × {high:g} m: "
            "`flight.stare_east_m` and `flight.stare_north_m` are from its centre"
        )


def _flight_notes(case: Case, of: Feasibility) -> Iterator[str]:
    if of.dwell_frames < _MIN_FRAMES:
        yield f"a vehicle at 50 km/h is in sight for {of.dwell_frames:.2g} frames"
    if case.flight.frames < _MIN_FRAMES:
        yield f"{case.flight.frames} frames are few to confirm a track"
    elif (length_s := (case.flight.frames - 1) / case.flight.rate_hz) < MIN_SCORED_S:
        yield f"{case.flight.frames} frames in {length_s:.2g} s are too short: the background is learnt first"
