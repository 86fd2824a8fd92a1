"""Recorded traffic: trajectories sampled by SUMO as centres, headings and velocities; recordings as files.

SUMO reports the centre of the *front bumper* and an angle clockwise from north. Both are converted here,
once, to the centre of the vehicle and a smoothed heading; everything downstream sees centres. Smoothing is a
Hann window of ±0.3 s: SUMO turns vehicles in steps of up to 15° on the short straight pieces inside
junctions. A recording is a network and its traffic in one NetCDF file: the embedded city's data, the cache of
SUMO runs.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.io.netcdf import write_dataset
from glintrack.scene.objects.surfaces import LANE_KINDS, Lane, RoadNetwork
from glintrack.scene.vehicles import VEHICLE_CLASSES, load_vehicles

_SMOOTHING_S = 0.3
_VELOCITY_SPAN_S = 0.2
_JAM_SHARE, _JAM_VEHICLES, _JAM_SAMPLES = 0.2, 20, 5  # in the packaged cities 0.30 move, in Berlin 0.16


@dataclass(frozen=True)
class Traffic:
    """Trajectories of many vehicles on one clock, vehicle after vehicle.

    Parameters
    ----------
    step_s
        Sampling interval. [s]
    steps
        Number of samples of the whole recording; it covers 0 to ``(steps − 1) · step_s``.
    first, count
        Sample of the clock at which each vehicle appears, and for how many it stays.
    model
        Index of each vehicle into `VEHICLE_CLASSES`.
    bumper_east, bumper_north
        Front-bumper centre of every sample of every vehicle, ENU. [m]
    angle
        Heading clockwise from north of the same samples. [rad]
    """

    step_s: float
    steps: int
    first: Int[Array, "vehicle"]
    count: Int[Array, "vehicle"]
    model: Int[Array, "vehicle"]
    bumper_east: Float[Array, "sample"]
    bumper_north: Float[Array, "sample"]
    angle: Float[Array, "sample"]

    def __post_init__(self):
        """Refuse tables that do not belong together."""
        samples = int(self.count.sum())
        for name in ("bumper_east", "bumper_north", "angle"):
            values = getattr(self, name)
            if values.shape != (samples,):
                raise ValueError(f"`{name}` must hold {samples} samples; got {values.shape}.")
            if not np.isfinite(values).all():
                raise ValueError(f"`{name}` must be finite; got {np.sum(~np.isfinite(values))} that are not.")
        if self.count.size and (self.count.min() < 1 or (self.first + self.count).max() > self.steps):
            raise ValueError(f"`count` must keep every vehicle within {self.steps} steps; got one beyond.")
        if self.model.size and not 0 <= self.model.min() <= self.model.max() < len(VEHICLE_CLASSES):
            raise ValueError(
                f"`model` must index the {len(VEHICLE_CLASSES)} vehicle models; got {self.model.max()}."
            )

    def shift(self, east_m: float, north_m: float) -> "Traffic":
        """Move the origin by adding a vector to all coordinates. [m]"""
        east, north = self.bumper_east + east_m, self.bumper_north + north_m
        return replace(self, bumper_east=east, bumper_north=north)

    @property
    def duration_s(self) -> float:
        """Time of the last sample. [s]"""
        return (self.steps - 1) * self.step_s

    @cached_property
    def dimensions(self) -> Float[Array, "vehicle 3"]:
        """Length, width and height of each vehicle. [m]"""
        table = np.array([[d.length_m, d.width_m, d.height_m] for d in load_vehicles().values()])
        return table[self.model]

    @cached_property
    def _states(self) -> Float[Array, "sample 5"]:
        """Centre east, north [m], unwrapped heading [rad], east and north speed [m s⁻¹] of every sample."""
        states = np.empty((self.angle.size, 5))
        offsets = np.concatenate([[0], np.cumsum(self.count)])
        reach = max(round(_VELOCITY_SPAN_S / self.step_s), 1)
        smooth = round(_SMOOTHING_S / self.step_s)
        kernel = np.hanning(2 * smooth + 3)[1:-1]  # a running mean, with repeated end values
        for k, length_m in enumerate(self.dimensions[:, 0]):
            span, n = slice(offsets[k], offsets[k + 1]), self.count[k]
            heading = np.unwrap(self.angle[span])
            if smooth and n > 1:
                padded = np.pad(heading, smooth, mode="edge")
                heading = np.convolve(padded, kernel / kernel.sum(), mode="valid")
            forward = np.stack([np.sin(heading), np.cos(heading)], axis=1)
            bumper = np.stack([self.bumper_east[span], self.bumper_north[span]], axis=1)
            centre = bumper - 0.5 * float(length_m) * forward
            low, high = np.maximum(np.arange(n) - reach, 0), np.minimum(np.arange(n) + reach, n - 1)
            span_s = np.maximum(high - low, 1)[:, None] * self.step_s
            velocity = (centre[high] - centre[low]) / span_s
            states[span] = np.concatenate([centre, heading[:, None], velocity], axis=1)
        return states

    def at(self, time_s: float) -> tuple[Int[Array, "present"], Float[Array, "present 5"]]:
        """Interpolate the vehicles that are present at a time linearly between samples.

        Parameters
        ----------
        time_s
            On the recording's clock. [s]

        Returns
        -------
        Vehicle ids (index into the recording, stable over time), and for each: centre east, north [m],
        heading in [0, 2π) [rad], east and north speed [m s⁻¹].

        Raises
        ------
        ValueError
            If the time is outside the recording.
        """
        position = time_s / self.step_s
        if not -1e-5 <= position <= self.steps - 1 + 1e-5:  # a part of a step: rounding of the clock
            raise ValueError(
                f"`time_s` must lie within the recorded traffic, 0 to {self.duration_s:g} s; got {time_s:g}."
            )
        position = min(max(position, 0.0), self.steps - 1.0)
        ids = np.flatnonzero((self.first <= position) & (position <= self.first + self.count - 1))
        offsets = np.cumsum(self.count) - self.count
        within = position - self.first[ids]
        low = np.minimum(np.floor(within).astype(int), self.count[ids] - 1)
        high = np.minimum(low + 1, self.count[ids] - 1)
        weight = (within - low)[:, None]
        states = self._states
        now = (1 - weight) * states[offsets[ids] + low] + weight * states[offsets[ids] + high]
        now[:, 2] = np.mod(now[:, 2], 2 * np.pi)
        return ids, now


def warn_of_jam(traffic: Traffic, extent_m: tuple[float, float, float, float]) -> None:
    """Warn if fewer than a fifth of at least 20 vehicles in a window (west, south, east, north [m]) move."""
    west, south, east, north = extent_m
    inside = moving = 0.0
    for time_s in np.linspace(0.0, traffic.duration_s, _JAM_SAMPLES):
        x, y, _, *speed = traffic.at(float(time_s))[1].T
        here = (x >= west) & (x <= east) & (y >= south) & (y <= north)
        inside += here.sum() / _JAM_SAMPLES
        moving += (here & (np.hypot(*speed) >= MOVING_SPEED_M_S)).sum() / _JAM_SAMPLES
    if inside >= _JAM_VEHICLES and moving < _JAM_SHARE * inside:
        warnings.warn(
            f"of {inside:.0f} vehicles in the window {moving:.0f} move on average: the traffic jams, and "
            "scores count only those (raise `scene.traffic_insertion_period_s`, or move `scene.centre_m`)",
            stacklevel=3,
        )


FORMAT = 1
_LENGTH_UNIT_M = 0.001  # coordinates are stored in whole millimetres
_ANGLE_UNIT_RAD = 1e-4
_CODING = "first sample of each vehicle, then differences from sample to sample"


@dataclass(frozen=True)
class Recording:
    """Network and traffic in the same ENU frame."""

    network: RoadNetwork
    traffic: Traffic

    def shift(self, east_m: float, north_m: float) -> "Recording":
        """Move the origin by adding a vector to all coordinates. [m]"""
        return Recording(self.network.shift(east_m, north_m), self.traffic.shift(east_m, north_m))


def write_recording(path: Path, recording: Recording, attributes: Mapping[str, Any]) -> None:
    """Write a recording as compressed NetCDF-4.

    Parameters
    ----------
    path
        File to write.
    recording
        Coordinates are rounded to 1 mm, headings to 0.1 mrad.
    attributes
        Global attributes: at least ``title``, ``source`` and ``licence``.
    """
    traffic, lanes, junctions = recording.traffic, recording.network.lanes, recording.network.junctions
    lane_points, corners = (
        np.concatenate([np.zeros((0, 2)), *rings]) for rings in ([lane.points for lane in lanes], junctions)
    )
    types, edges = (sorted({getattr(lane, key) for lane in lanes}) for key in ("street_type", "edge_id"))
    headings = np.round(np.unwrap(traffic.angle) / _ANGLE_UNIT_RAD).astype(int)

    def column(dim: str, values: Any, **attributes: str) -> tuple:
        whole = np.asarray(values, dtype=np.int32)
        small = whole.size and np.abs(whole).max() < 2**15
        return dim, whole.astype(np.int16) if small else whole, attributes

    def lengths(dim: str, values: Any) -> tuple:
        return column(dim, _to_millimetres(values), units=f"{_LENGTH_UNIT_M} m")

    def samples(values: Array, units: str) -> tuple:
        return column("sample", _differences(values, traffic.count), units=units, coding=_CODING)

    tables = {
        "lane_point_count": column("lane", [len(lane.points) for lane in lanes]),
        "lane_kind": column(
            "lane", [LANE_KINDS.index(lane.kind) for lane in lanes], names=" ".join(LANE_KINDS)
        ),
        "lane_edge": column("lane", [edges.index(lane.edge_id) for lane in lanes], names=" ".join(edges)),
        "lane_index": column("lane", [lane.index for lane in lanes]),
        "lane_width": lengths("lane", [lane.width_m for lane in lanes]),
        "lane_signalled": column("lane", [lane.signalled for lane in lanes]),
        "lane_type": column("lane", [types.index(lane.street_type) for lane in lanes], names=";".join(types)),
        "lane_east": lengths("lane_point", lane_points[:, 0]),
        "lane_north": lengths("lane_point", lane_points[:, 1]),
        "junction_point_count": column("junction", [len(ring) for ring in junctions]),
        "junction_east": lengths("junction_point", corners[:, 0]),
        "junction_north": lengths("junction_point", corners[:, 1]),
        **{f"vehicle_{key}": column("vehicle", getattr(traffic, key)) for key in ("first", "count", "model")},
        "bumper_east": samples(_to_millimetres(traffic.bumper_east), f"{_LENGTH_UNIT_M} m"),
        "bumper_north": samples(_to_millimetres(traffic.bumper_north), f"{_LENGTH_UNIT_M} m"),
        "angle": samples(headings, f"{_ANGLE_UNIT_RAD} rad"),
    }
    about = {**attributes, "format": FORMAT, "step_s": traffic.step_s, "steps": traffic.steps}
    about |= {"left_hand": 1} if recording.network.left_hand else {}
    write_dataset(path, xr.Dataset(tables, attrs=about))


def read_recording(path: Path) -> Recording:
    """Read a recording that `write_recording` wrote.

    Raises
    ------
    ValueError
        If the file is not such a recording or is damaged.
    """
    try:
        file = xr.load_dataset(path, engine="h5netcdf", decode_cf=False)
        if file.attrs.get("format") != FORMAT:
            came = file.attrs.get("format")
            raise ValueError(f"`{path.name}` must be a recording of format {FORMAT}; got {came}.")
        step_s, steps = (float(np.asarray(file.attrs[name])) for name in ("step_s", "steps"))
        if not (step_s > 0 and 1 <= steps < 1e9):
            raise ValueError(f"`step_s` and `steps` must be greater than 0; got {step_s:g} and {steps:g}.")
        tables = {str(name): variable.values for name, variable in file.variables.items()}
        edges, types = (str(file[key].attrs["names"]) for key in ("lane_edge", "lane_type"))
        network = _network(tables, edges.split(" "), types.split(";"))
        network = replace(network, left_hand=bool(file.attrs.get("left_hand", 0)))
        count = tables["vehicle_count"].astype(np.int64)
        traffic = Traffic(
            step_s=step_s,
            steps=int(steps),
            first=tables["vehicle_first"].astype(np.int64),
            count=count,
            model=tables["vehicle_model"].astype(np.int64),
            bumper_east=_sums(tables["bumper_east"], count) * _LENGTH_UNIT_M,
            bumper_north=_sums(tables["bumper_north"], count) * _LENGTH_UNIT_M,
            angle=_sums(tables["angle"], count) * _ANGLE_UNIT_RAD,
        )
    except (OSError, LookupError, TypeError, AttributeError, RuntimeError, OverflowError) as error:
        raise ValueError(f"`{path.name}` must be a whole recording; got {error!r}.") from error
    return Recording(network, traffic)


def _network(tables: Mapping[str, Array], edges: list[str], types: list[str]) -> RoadNetwork:
    def rings(kind: str) -> list[Array]:
        points = np.stack([tables[f"{kind}_east"], tables[f"{kind}_north"]], axis=1) * _LENGTH_UNIT_M
        ends = np.cumsum(tables[f"{kind}_point_count"].astype(int))
        return np.split(points, ends[:-1]) if len(points) else []

    lanes = tuple(
        Lane(
            edge_id=edges[tables["lane_edge"][i]],
            index=int(tables["lane_index"][i]),
            kind=LANE_KINDS[tables["lane_kind"][i]],
            points=points,
            width_m=float(tables["lane_width"][i] * _LENGTH_UNIT_M),
            signalled=bool(tables["lane_signalled"][i]),
            street_type=types[tables["lane_type"][i]],
        )
        for i, points in enumerate(rings("lane"))
    )
    return RoadNetwork(lanes, tuple(rings("junction")))


def _to_millimetres(values: Any) -> Array:
    return np.round(np.asarray(values, dtype=float) / _LENGTH_UNIT_M).astype(int)


def _differences(values: Array, count: Array) -> Array:
    """First value of each vehicle, then differences between samples, which compress well."""
    starts = np.cumsum(count) - count
    steps = np.diff(values, prepend=0)
    steps[starts] = values[starts]
    return steps


def _sums(steps: Array, count: Array) -> Array:
    """Invert `_differences`."""
    starts = np.cumsum(count) - count
    total = np.cumsum(steps.astype(np.int64))
    before = np.where(starts > 0, total[np.maximum(starts - 1, 0)], 0)
    return total - np.repeat(before, count)
