"""The embedded city: a seeded procedural neighbourhood, by default on the shipped street network.

SUMO simulated the shipped traffic on the shipped streets, with their lanes, crossings and signals
(``tools/record_embedded_traffic.py``). The seed determines the buildings and plants between them. A city of
another size has streets drawn from its seed, a gently winding grid, and its own traffic from SUMO.
"""

import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter
from shapely.geometry import Point, Polygon

from glintrack.core.installation import data_file, read_data
from glintrack.scene.design import DEFAULT_SIZE_M, SceneDesign
from glintrack.scene.objects.layout import Layout, area_with_margin, expand_extent
from glintrack.scene.objects.surfaces import RoadNetwork, road_areas
from glintrack.scene.read.sumo import FULL_MIX, NETCONVERT, SumoRun, load_or_simulate
from glintrack.scene.sources.neighbourhood import Use, neighbourhood, use_by_size
from glintrack.scene.sources.site import ROCHESTER, VEHICLE_MARGIN_M, Site, read_traffic
from glintrack.scene.traffic import Recording, read_recording

_DATA = read_data("cities.toml")
_SHIPPED_PERIOD_S, _SHIPPED_GRID_M2 = 0.44, 1060.0 * 790.0


def procedural_site(design: SceneDesign) -> Site:
    """Streets, traffic and layout rule of a design with city ``embedded``."""
    shipped = design.size_m == DEFAULT_SIZE_M
    reach = expand_extent(design.extent_m, VEHICLE_MARGIN_M)
    if design.uses_shipped_traffic:
        recording = load_shipped_recording()
    else:
        recording = _simulate(design, SHIPPED_PLAN if shipped else None, reach)
    if design.traffic_file:
        recording = replace(recording, traffic=read_traffic(design, reach))
    fill = partial(fill_streets, recording.network, design.extent_m, shipped=shipped)
    return Site(recording, ROCHESTER, design.extent_m, fill)


def load_shipped_recording() -> Recording:
    """Load the shipped street network and traffic."""
    return read_recording(data_file("traffic", "embedded.nc"))


def _simulate(
    design: SceneDesign, plan: "StreetPlan | None", reach_m: tuple[float, float, float, float]
) -> Recording:
    """Traffic of SUMO on a street plan, by default one drawn from the seed; as dense as the shipped one."""
    wide, high = design.size_m
    period_s = design.traffic_insertion_period_s
    if period_s is None:
        grid_m2 = (wide + 2 * NETWORK_MARGIN_M) * (high + 2 * NETWORK_MARGIN_M)
        period_s = round(max(_SHIPPED_PERIOD_S * _SHIPPED_GRID_M2 / grid_m2, 0.05), 2)
    plan = plan or draw_plan(wide, high, np.random.default_rng(design.seed))
    with tempfile.TemporaryDirectory(prefix="glintrack-streets-") as scratch:
        paths = Path(scratch) / "city.nod.xml", Path(scratch) / "city.edg.xml"
        for path, text in zip(paths, plan_xml(plan), strict=True):
            path.write_text(text, encoding="utf-8")
        return load_or_simulate(
            SumoRun(
                inputs=paths,
                netconvert=("-n", paths[0].name, "-e", paths[1].name, *NETCONVERT["embedded"]),
                extent_m=(*reach_m,),
                origin_m=(0.0, 0.0),
                duration_s=design.traffic_duration_s,
                insertion_period_s=period_s,
                seed=design.seed,
                mix=FULL_MIX,
            )
        )


def fill_streets(
    network: RoadNetwork,
    extent_m: tuple[float, float, float, float],
    rng: np.random.Generator,
    shipped: bool = True,
) -> Layout:
    """Fill the blocks of a street network.

    Parameters
    ----------
    network
        Streets.
    extent_m
        West, south, east, north of the window. [m]
    rng
        Source of all random choices.
    shipped
        Use the planned uses of the shipped blocks; else each block gets a use by its size.
    """
    area = area_with_margin(extent_m)
    streets = road_areas(network, area)
    return neighbourhood(network, streets, area, _use_by_plan if shipped else use_by_size, rng)


def _use_by_plan(block: Polygon, rng: np.random.Generator) -> Use:
    uses: list[Use] = [use for use, at in _DATA["uses"].items() if any(block.contains(Point(p)) for p in at)]
    return uses[0] if uses else "housing"


NETWORK_MARGIN_M = 200.0  # of streets beyond the window, where traffic comes from
_PARKING_LANE = '<lane index="0" disallow="all" width="2.2"/>'


@dataclass(frozen=True)
class StreetPlan:
    """A grid of streets.

    Parameters
    ----------
    columns, rows
        East of the streets that run north, and north of those that run east. [m]
    arterial_columns, arterial_rows, collector_columns, collector_rows
        Indices of those that are more than residential streets.
    left_out
        Missing pieces, as (``h`` or ``v``, column, row) of their western or southern end: each joins two
        blocks.
    """

    columns: tuple[float, ...]
    rows: tuple[float, ...]
    arterial_columns: frozenset[int]
    arterial_rows: frozenset[int]
    collector_columns: frozenset[int] = frozenset()
    collector_rows: frozenset[int] = frozenset()
    left_out: frozenset[tuple[str, int, int]] = frozenset()

    def node(self, column: int, row: int) -> tuple[str, float, float]:
        """Name and position of a crossing; streets wind gently, so that no two are exactly parallel."""
        x, y = self.columns[column], self.rows[row]
        return (
            f"n{column}_{row}",
            x + 9 * np.sin(y / 95) + 4 * np.sin(y / 41 + x),
            y + 8 * np.sin(x / 120) + 4 * np.sin(x / 57 + y),
        )


SHIPPED_PLAN = TypeAdapter(StreetPlan).validate_python(_DATA["shipped_plan"])


def draw_plan(width_m: float, height_m: float, rng: np.random.Generator) -> StreetPlan:
    """Draw a plan for a window of any size, west to east and south to north. [m]"""
    columns, rows = (
        _lines(size_m / 2 + NETWORK_MARGIN_M, spacing, rng)
        for size_m, spacing in ((width_m, (100, 130)), (height_m, (92, 115)))
    )
    arterial_columns, arterial_rows = (_every(len(lines), 4, rng) for lines in (columns, rows))
    collector_columns, collector_rows = (
        _every(len(lines), 3, rng) - arterial
        for lines, arterial in ((columns, arterial_columns), (rows, arterial_rows))
    )
    left_out = set()
    for c in range(1, len(columns) - 2):
        for r in range(1, len(rows) - 2):
            horizontal = rng.random() < 0.5
            axis, along = ("h", r) if horizontal else ("v", c)
            major = arterial_rows | collector_rows if horizontal else arterial_columns | collector_columns
            near = {(axis, c + i, r + j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
            if rng.random() < 0.08 and along not in major and not left_out & near:
                left_out.add((axis, c, r))
    return StreetPlan(
        columns,
        rows,
        arterial_columns=arterial_columns,
        arterial_rows=arterial_rows,
        collector_columns=collector_columns,
        collector_rows=collector_rows,
        left_out=frozenset(left_out),
    )


def plan_xml(plan: StreetPlan) -> tuple[str, str]:
    """Nodes and edges as SUMO's plain XML."""
    nodes, edges = ["<nodes>"], ["<edges>"]
    for c in range(len(plan.columns)):
        for r in range(len(plan.rows)):
            name, x, y = plan.node(c, r)
            major = c in plan.arterial_columns | plan.collector_columns
            major = major and r in plan.arterial_rows | plan.collector_rows
            inner = 0 < c < len(plan.columns) - 1 and 0 < r < len(plan.rows) - 1
            kind = "traffic_light" if major and inner else "priority"
            nodes.append(f'<node id="{name}" x="{x:.2f}" y="{y:.2f}" type="{kind}"/>')
            for axis, c2, r2 in (("h", c + 1, r), ("v", c, r + 1)):
                if c2 >= len(plan.columns) or r2 >= len(plan.rows) or (axis, c, r) in plan.left_out:
                    continue
                if r in plan.arterial_rows if axis == "h" else c in plan.arterial_columns:
                    street, parking = 'numLanes="2" speed="13.89" type="street.arterial" priority="3"', ""
                elif r in plan.collector_rows if axis == "h" else c in plan.collector_columns:
                    street, parking = 'numLanes="1" speed="13.89" type="street.collector" priority="2"', ""
                else:  # the second lane is for parking only
                    street = 'numLanes="2" speed="8.33" type="street.residential" priority="1"'
                    parking = _PARKING_LANE
                end = plan.node(c2, r2)[0]
                for a, b in ((name, end), (end, name)):
                    edges.append(f'<edge id="{a}-{b}" from="{a}" to="{b}" {street}>{parking}</edge>')
    return "\n".join([*nodes, "</nodes>"]), "\n".join([*edges, "</edges>"])


def _lines(half_m: float, spacing_m: tuple[float, float], rng: np.random.Generator) -> tuple[float, ...]:
    count = max(round(2 * half_m / np.mean(spacing_m)), 3)
    steps = rng.uniform(*spacing_m, count)
    places = np.r_[0, np.cumsum(steps)] * 2 * half_m / steps.sum() - half_m
    return tuple(float(p) for p in np.round(places))


def _every(count: int, step: int, rng: np.random.Generator) -> frozenset[int]:
    """Every few of the inner lines, from a random one on; at least one."""
    first = 1 + int(rng.integers(0, max(min(step, count - 2), 1)))
    return frozenset(range(first, count - 1, step))
