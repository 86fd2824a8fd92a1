"""Recorded traffic: trajectories sampled by SUMO as centres, headings and velocities; recordings as files.

SUMO reports the centre of the *front bumper* and an angle clockwise from north. Both are converted here,
once, to the centre of the vehicle and a smoothed heading; everything downstream sees centres. Smoothing is a
Hann window of ±0.3 s: SUMO turns vehicles in steps of up to 15° on the short straight pieces inside
junctions. A recording is a network and its traffic in one NetCDF file: the embedded city's data, the cache of
SUMO runs.
"""

import io
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5netcdf
import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.io.atomic import write_bytes
from glintrack.scene.objects.surfaces import LANE_KINDS, Lane, RoadNetwork
from glintrack.scene.vehicles import MODELS

_SMOOTHING_S = 0.3
_VELOCITY_SPAN_S = 0.2
_JAM_SHARE, _JAM_VEHICLES, _JAM_LOOKS = (
    0.2,
    20,
    5,
)  # in the packaged cities 0.30 and more move, in Berlin 0.16


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
        Index of each vehicle into `vehicles.MODELS`.
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
                raise ValueError(f"`{name}` must hold {samples} samples, got {values.shape}")
            if not np.isfinite(values).all():
                raise ValueError(
                    f"`{name}` must be finite, got {int((~np.isfinite(values)).sum())} that are not"
                )
        if self.count.size and (self.count.min() < 1 or (self.first + self.count).max() > self.steps):
            raise ValueError(f"`count` must keep every vehicle within {self.steps} steps, got one beyond")
        if self.model.size and not 0 <= self.model.min() <= self.model.max() < len(MODELS):
            raise ValueError(f"`model` must index the {len(MODELS)} vehicle models, got {self.model.max()}")

    @property
    def duration_s(self) -> float:
        """Time of the last sample. [s]"""
        return (self.steps - 1) * self.step_s

    @cached_property
    def dimensions(self) -> Float[Array, "vehicle 3"]:
        """Length, width and height of each vehicle. [m]"""
        table = np.array([[d.length_m, d.width_m, d.height_m] for d in MODELS.values()])
        return table[self.model]

    @cached_property
    def _states(self) -> Float[Array, "sample 5"]:
        """Centre east, north [m], unwrapped heading [rad], east and north speed [m s⁻¹] of every sample."""
        states = np.empty((self.angle.size, 5))
        offsets = np.concatenate([[0], np.cumsum(self.count)])
        for k, length_m in enumerate(self.dimensions[:, 0]):
            span = slice(offsets[k], offsets[k + 1])
            bumper = np.stack([self.bumper_east[span], self.bumper_north[span]], axis=1)
            states[span] = _vehicle_states(bumper, self.angle[span], float(length_m), self.step_s)
        return states

    def at(self, time_s: float) -> tuple[Int[Array, "present"], Float[Array, "present 5"]]:
        """Who is there at a time, and how: linear between samples.

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
            Outside the recording.
        """
        position = time_s / self.step_s
        if not -1e-6 <= position <= self.steps - 1 + 1e-6:  # a millionth of a step: rounding of the clock
            raise ValueError(
                f"`time_s` must lie within the traffic recording, 0 to {self.duration_s:g} s, got {time_s:g}"
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


def bumper_to_centre(
    bumper: Float[Array, "n 2"], heading_rad: Float[Array, "n"], length_m: float
) -> Float[Array, "n 2"]:
    """Centre of a vehicle from its front-bumper centre and heading clockwise from north. [m]."""
    forward = np.stack([np.sin(heading_rad), np.cos(heading_rad)], axis=1)
    return bumper - 0.5 * length_m * forward


def warn_of_jam(traffic: Traffic, extent_m: tuple[float, float, float, float]) -> None:
    """Tell where less than a fifth of twenty and more vehicles in a window move: scores would be of few.

    Parameters
    ----------
    traffic
        Looked at evenly from its begin to its end.
    extent_m
        West, south, east, north of the window. [m]
    """
    west, south, east, north = extent_m
    inside = moving = 0.0
    for time_s in np.linspace(0.0, traffic.duration_s, _JAM_LOOKS):
        x, y, _, *speed = traffic.at(float(time_s))[1].T
        here = (x >= west) & (x <= east) & (y >= south) & (y <= north)
        inside += here.sum() / _JAM_LOOKS
        moving += (here & (np.hypot(*speed) >= MOVING_SPEED_M_S)).sum() / _JAM_LOOKS
    if inside >= _JAM_VEHICLES and moving < _JAM_SHARE * inside:
        warnings.warn(
            f"of {inside:.0f} vehicles in the window {moving:.0f} move in the mean: the traffic jams, and "
            "scores are of those few (raise `scene.traffic_insertion_period_s`, or move `scene.centre_m`)",
            stacklevel=3,
        )


def truth_dataset(
    ids: Int[Array, "vehicle"],
    states: Float[Array, "vehicle 5"],
    dimensions: Float[Array, "vehicle 3"],
    up_m: Float[Array, "vehicle"] | float = 0.0,
    pitch_rad: Float[Array, "vehicle"] | float = 0.0,
    extent_m: tuple[float, float, float, float] = (-np.inf, -np.inf, np.inf, np.inf),
) -> xr.Dataset:
    """Dataset of schema ``truth`` from what `Traffic.at` gives.

    Parameters
    ----------
    ids, states, dimensions
        Of each vehicle.
    up_m, pitch_rad
        Height of the ground under the centre, and its slope along the heading, nose up positive. [m, rad]
    extent_m
        West, south, east, north of the window. [m]

    Returns
    -------
    Beside the schema's: ``pitch``, ``inside`` (1 within the window) and ``moving`` (1 from 1 m s⁻¹).
    """
    west, south, east, north = extent_m
    inside = (states[:, 0] >= west) & (states[:, 0] <= east)
    inside &= (states[:, 1] >= south) & (states[:, 1] <= north)

    def column(values: Array, units: str) -> tuple:
        return "vehicle", np.asarray(values, dtype=float), {"units": units}

    dataset = xr.Dataset(
        {
            "east": column(states[:, 0], "m"),
            "north": column(states[:, 1], "m"),
            "up": column(np.broadcast_to(up_m, len(ids)), "m"),
            "east_speed": column(states[:, 3], "m s-1"),
            "north_speed": column(states[:, 4], "m s-1"),
            "heading": column(states[:, 2], "rad"),
            "pitch": column(np.broadcast_to(pitch_rad, len(ids)), "rad"),
            "length": column(dimensions[:, 0], "m"),
            "width": column(dimensions[:, 1], "m"),
            "height": column(dimensions[:, 2], "m"),
            "inside": column(inside, "1"),
            "moving": column(np.hypot(states[:, 3], states[:, 4]) >= MOVING_SPEED_M_S, "1"),
        },
        coords={"vehicle": np.asarray(ids, dtype=np.int64)},
    )
    return schema.check(dataset, "truth")


def _vehicle_states(bumper: Array, angle: Array, length_m: float, step_s: float) -> Float[Array, "n 5"]:
    heading = _smooth(np.unwrap(angle), step_s)
    centre = bumper_to_centre(bumper, heading, length_m)
    reach = max(round(_VELOCITY_SPAN_S / step_s), 1)
    n = len(centre)
    low, high = np.maximum(np.arange(n) - reach, 0), np.minimum(np.arange(n) + reach, n - 1)
    span_s = np.maximum(high - low, 1)[:, None] * step_s
    velocity = (centre[high] - centre[low]) / span_s
    return np.concatenate([centre, heading[:, None], velocity], axis=1)


def _smooth(values: Float[Array, "n"], step_s: float) -> Float[Array, "n"]:
    """Hann-weighted running mean; the ends are held, not padded with zeros."""
    reach = round(_SMOOTHING_S / step_s)
    if reach < 1 or values.size < 2:
        return values
    kernel = np.hanning(2 * reach + 3)[1:-1]
    return np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), mode="valid")


FORMAT = 1
_LENGTH_UNIT_M = 0.001  # coordinates are stored in whole millimetres
_ANGLE_UNIT_RAD = 1e-4


@dataclass(frozen=True)
class Recording:
    """Network and traffic in the same ENU frame."""

    network: RoadNetwork
    traffic: Traffic


def write_recording(path: Path, recording: Recording, attributes: Mapping[str, Any]) -> None:
    """Write a recording as compressed NetCDF-4.

    Parameters
    ----------
    path
        File to make.
    recording
        What to write; coordinates are rounded to 1 mm, headings to 0.1 mrad.
    attributes
        Global attributes: at least ``title``, ``source`` and ``licence``.
    """
    network, traffic = recording.network, recording.traffic
    lane_points = np.concatenate([np.zeros((0, 2)), *(lane.points for lane in network.lanes)])
    junction_points = np.concatenate([np.zeros((0, 2)), *network.junctions])
    types = sorted({lane.street_type for lane in network.lanes})
    edges = sorted({lane.edge_id for lane in network.lanes})
    lanes = network.lanes
    tables = {
        "lane_point_count": ("lane", [len(lane.points) for lane in lanes], {}),
        "lane_kind": (
            "lane",
            [LANE_KINDS.index(lane.kind) for lane in lanes],
            {"names": " ".join(LANE_KINDS)},
        ),
        "lane_edge": ("lane", [edges.index(lane.edge_id) for lane in lanes], {"names": " ".join(edges)}),
        "lane_index": ("lane", [lane.index for lane in lanes], {}),
        "lane_width": ("lane", _packed([lane.width_m for lane in lanes]), _LENGTH),
        "lane_signalled": ("lane", [int(lane.signalled) for lane in lanes], {}),
        "lane_type": ("lane", [types.index(lane.street_type) for lane in lanes], {"names": ";".join(types)}),
        "lane_east": ("lane_point", _packed(lane_points[:, 0]), _LENGTH),
        "lane_north": ("lane_point", _packed(lane_points[:, 1]), _LENGTH),
        "junction_point_count": ("junction", [len(c) for c in network.junctions], {}),
        "junction_east": ("junction_point", _packed(junction_points[:, 0]), _LENGTH),
        "junction_north": ("junction_point", _packed(junction_points[:, 1]), _LENGTH),
        "vehicle_first": ("vehicle", traffic.first, {}),
        "vehicle_count": ("vehicle", traffic.count, {}),
        "vehicle_model": ("vehicle", traffic.model, {}),
        "bumper_east": ("sample", _steps(_packed(traffic.bumper_east), traffic.count), _STEPPED),
        "bumper_north": ("sample", _steps(_packed(traffic.bumper_north), traffic.count), _STEPPED),
        "angle": (
            "sample",
            _steps(np.round(np.unwrap(traffic.angle) / _ANGLE_UNIT_RAD).astype(int), traffic.count),
            {"units": f"{_ANGLE_UNIT_RAD} rad", "coding": _STEPPED["coding"]},
        ),
    }
    made = io.BytesIO()  # HDF5 crashes where it cannot write, on a full disk
    with h5netcdf.File(made, "w") as file:
        file.attrs.update({**attributes, "format": FORMAT, "step_s": traffic.step_s, "steps": traffic.steps})
        for name, (dim, values, attrs) in tables.items():
            values = np.asarray(values, dtype=np.int32)
            if dim not in file.dimensions:
                file.dimensions[dim] = len(values)
            if values.size and np.abs(values).max() < 2**15:
                values = values.astype(np.int16)
            options = {"compression": "gzip", "compression_opts": 9, "shuffle": True} if values.size else {}
            variable = file.create_variable(name, (dim,), values.dtype, data=values, **options)
            variable.attrs.update(attrs)
    write_bytes(path, made.getvalue())


def read_recording(path: Path) -> Recording:
    """Read what `write_recording` wrote.

    Raises
    ------
    ValueError
        If the file is not such a recording or is damaged.
    """
    try:
        with h5netcdf.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                came = file.attrs.get("format")
                raise ValueError(f"`{path.name}` must be a recording of format {FORMAT}, got {came}")
            tables = {name: np.asarray(variable[...]) for name, variable in file.variables.items()}
            names = {name: str(v.attrs["names"]) for name, v in file.variables.items() if "names" in v.attrs}
            step_s, steps = (float(np.asarray(file.attrs[name])) for name in ("step_s", "steps"))
    except (OSError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(f"`{path.name}` must be a whole recording, got {error}") from error
    try:
        return _recording(tables, names, step_s, steps)
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"`{path.name}` must be a whole recording, got {error!r}") from error


def _recording(
    tables: Mapping[str, Array], names: Mapping[str, str], step_s: float, steps: float
) -> Recording:
    if not (step_s > 0 and 1 <= steps < 1e9):
        raise ValueError(f"`step_s` and `steps` must be greater than 0, got {step_s:g} and {steps:g}")
    count = tables["vehicle_count"].astype(np.int64)
    traffic = Traffic(
        step_s=step_s,
        steps=int(steps),
        first=tables["vehicle_first"].astype(np.int64),
        count=count,
        model=tables["vehicle_model"].astype(np.int64),
        bumper_east=_unsteps(tables["bumper_east"], count) * _LENGTH_UNIT_M,
        bumper_north=_unsteps(tables["bumper_north"], count) * _LENGTH_UNIT_M,
        angle=_unsteps(tables["angle"], count) * _ANGLE_UNIT_RAD,
    )
    return Recording(_network(tables, names), traffic)


_LENGTH = {"units": f"{_LENGTH_UNIT_M} m"}
_STEPPED = {**_LENGTH, "coding": "first sample of each vehicle, then differences from sample to sample"}


def _network(tables: Mapping[str, Array], names: Mapping[str, str]) -> RoadNetwork:
    def rings(kind: str) -> list[Array]:
        points = np.stack([tables[f"{kind}_east"], tables[f"{kind}_north"]], axis=1) * _LENGTH_UNIT_M
        return (
            np.split(points, np.cumsum(tables[f"{kind}_point_count"].astype(int))[:-1]) if len(points) else []
        )

    edges, types = names["lane_edge"].split(" "), names["lane_type"].split(";")
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


def _packed(values) -> Array:
    return np.round(np.asarray(values, dtype=float) / _LENGTH_UNIT_M).astype(int)


def _steps(values: Array, count: Array) -> Array:
    """First value of each vehicle, then differences: neighbours differ little, so that this packs well."""
    starts = np.cumsum(count) - count
    steps = np.diff(values, prepend=0)
    steps[starts] = values[starts]
    return steps


def _unsteps(steps: Array, count: Array) -> Array:
    starts = np.cumsum(count) - count
    total = np.cumsum(steps.astype(np.int64))
    before = np.where(starts > 0, total[np.maximum(starts - 1, 0)], 0)
    return total - np.repeat(before, count)
