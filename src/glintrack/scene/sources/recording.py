"""A network and its recorded traffic in one NetCDF file: the embedded city's data, the cache of SUMO runs."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5netcdf
import numpy as np

from glintrack.core.arrays import Array
from glintrack.io.atomic import write_bytes
from glintrack.scene.objects.surfaces import LANE_KINDS, Lane, RoadNetwork
from glintrack.scene.traffic import Traffic

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
