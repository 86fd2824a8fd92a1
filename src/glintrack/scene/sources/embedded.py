"""The embedded city: a seeded procedural neighbourhood, by default on the shipped street network.

The streets, with their lanes, crossings and signals, are those SUMO drove on when the traffic was recorded
(``tools/record_embedded_traffic.py``); what stands between them is drawn from the seed. A city of another
size gets streets drawn from its seed, a grid that swings gently, and its traffic from SUMO.
"""

import tempfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from shapely.geometry import Point, Polygon

from glintrack.scene.objects.layout import Layout, covered_area
from glintrack.scene.objects.surfaces import RoadNetwork, road_areas
from glintrack.scene.read.sumo import FULL_MIX, SumoRun, recorded
from glintrack.scene.sources.neighbourhood import Use, neighbourhood, use_by_size
from glintrack.scene.traffic import Recording, read_recording

# Points inside the blocks of the shipped plan that are not housing; see `street_plan.SHIPPED_PLAN`. [m]
_SHOPPING, _OFFICES, _PARK = Point(25, -65), Point(195, -15), Point(-225, 135)
_TOWN = tuple(
    Point(p) for p in ((25, 88), (-100, -15), (-100, 88), (255, 88), (365, 88), (365, -15), (150, 88))
)
_SHIPPED_PERIOD_S, _SHIPPED_GRID_M2 = 0.44, 1060.0 * 790.0


def embedded_recording() -> Recording:
    """The shipped street network and traffic."""
    source = resources.files("glintrack") / "data" / "traffic" / "embedded.nc"
    with resources.as_file(source) as path:
        return read_recording(path)


def drawn_recording(
    extent_m: tuple[float, float, float, float],
    margin_m: float,
    seed: int,
    duration_s: float,
    insertion_period_s: float | None,
    shipped: bool = False,
) -> Recording:
    """Streets drawn from a seed for a window of any size, and SUMO's traffic on them.

    Parameters
    ----------
    extent_m
        West, south, east, north of the window. [m]
    margin_m
        Traffic is kept this far beyond it. [m]
    seed
        Of the streets and of the trips.
    duration_s
        Length of the recording. [s]
    insertion_period_s
        One vehicle enters each such interval; by default as many an area as in the shipped recording. [s]
    shipped
        Drive on the streets of the shipped recording instead.
    """
    west, south, east, north = extent_m
    if insertion_period_s is None:
        grid_m2 = (east - west + 2 * NETWORK_MARGIN_M) * (north - south + 2 * NETWORK_MARGIN_M)
        insertion_period_s = round(max(_SHIPPED_PERIOD_S * _SHIPPED_GRID_M2 / grid_m2, 0.05), 2)
    rng = np.random.default_rng(seed)
    plan = SHIPPED_PLAN if shipped else draw_plan(east - west, north - south, rng)
    with tempfile.TemporaryDirectory(prefix="glintrack-streets-") as scratch:
        paths = Path(scratch) / "city.nod.xml", Path(scratch) / "city.edg.xml"
        for path, text in zip(paths, plan_xml(plan), strict=True):
            path.write_text(text, encoding="utf-8")
        return recorded(
            SumoRun(
                inputs=paths,
                netconvert=("-n", paths[0].name, "-e", paths[1].name, *NETCONVERT),
                extent_m=(west - margin_m, south - margin_m, east + margin_m, north + margin_m),
                origin_m=(0.0, 0.0),
                duration_s=duration_s,
                insertion_period_s=insertion_period_s,
                seed=seed,
                mix=FULL_MIX,
            )
        )


def embedded_layout(
    network: RoadNetwork,
    extent_m: tuple[float, float, float, float],
    rng: np.random.Generator,
    shipped: bool = True,
) -> Layout:
    """Fill the blocks of the street network.

    Parameters
    ----------
    network
        Streets.
    extent_m
        West, south, east, north of the window. [m]
    rng
        Draws everything.
    shipped
        The streets are the shipped ones, whose blocks have planned uses; else each has what its size suits.
    """
    area = covered_area(extent_m)
    streets = road_areas(network, area)
    return neighbourhood(network, streets, area, _planned_use if shipped else use_by_size, rng)


def _planned_use(block: Polygon, rng: np.random.Generator) -> Use:
    if block.contains(_SHOPPING):
        return "shopping"
    if block.contains(_OFFICES):
        return "offices"
    if block.contains(_PARK):
        return "park"
    return "town" if any(block.contains(p) for p in _TOWN) else "housing"


NETCONVERT = (
    *("--offset.disable-normalization", "--junctions.corner-detail", "5"),
    *("--no-turnarounds.except-deadend", "--tls.default-type", "actuated"),
    *("--sidewalks.guess", "--sidewalks.guess.max-speed", "20", "--crossings.guess"),
    *("--default.lanewidth", "3.4", "--default.junctions.radius", "6"),
)
NETWORK_MARGIN_M = 200.0  # streets go on this far beyond a window, so that traffic has somewhere to come from
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
        Pieces that are missing, as (``h`` or ``v``, column, row) of their western or southern end: two blocks
        then make one.
    """

    columns: tuple[float, ...]
    rows: tuple[float, ...]
    arterial_columns: frozenset[int]
    arterial_rows: frozenset[int]
    collector_columns: frozenset[int] = frozenset()
    collector_rows: frozenset[int] = frozenset()
    left_out: frozenset[tuple[str, int, int]] = frozenset()

    def node(self, column: int, row: int) -> tuple[str, float, float]:
        """Name and place of a crossing; streets swing gently, so that no two run quite alike."""
        x, y = self.columns[column], self.rows[row]
        return (
            f"n{column}_{row}",
            x + 9 * np.sin(y / 95) + 4 * np.sin(y / 41 + x),
            y + 8 * np.sin(x / 120) + 4 * np.sin(x / 57 + y),
        )


# the pieces left out make room for a park, a shopping centre and offices
SHIPPED_PLAN = StreetPlan(
    columns=(-520, -395, -285, -165, -40, 90, 205, 310, 420, 540),
    rows=(-400, -270, -165, -70, 40, 135, 230, 390),
    arterial_columns=frozenset({4, 7}),
    arterial_rows=frozenset({4}),
    collector_columns=frozenset({2}),
    collector_rows=frozenset({2, 6}),
    left_out=frozenset({("h", 4, 3), ("v", 6, 3), ("h", 2, 5)}),
)


def draw_plan(width_m: float, height_m: float, rng: np.random.Generator) -> StreetPlan:
    """A plan for a window of any size, west to east and south to north. [m]"""
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
            axis = "h" if rng.random() < 0.5 else "v"
            along = r if axis == "h" else c
            major = (
                (arterial_rows | collector_rows) if axis == "h" else (arterial_columns | collector_columns)
            )
            beside = {(axis, c + i, r + j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
            if rng.random() < 0.08 and along not in major and not left_out & beside:
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
                arterial = r in plan.arterial_rows if axis == "h" else c in plan.arterial_columns
                collector = r in plan.collector_rows if axis == "h" else c in plan.collector_columns
                end = plan.node(c2, r2)[0]
                for a, b in ((name, end), (end, name)):
                    edges.append(
                        f'<edge id="{a}-{b}" from="{a}" to="{b}" {_street(arterial, collector)}>'
                        f"{'' if arterial or collector else _PARKING_LANE}</edge>"
                    )
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


def _street(arterial: bool, collector: bool) -> str:
    """Attributes of a street by its rank."""
    ranks = {(True, False): (2, 13.89, "arterial"), (False, True): (1, 13.89, "collector")}
    # a residential street's second lane is for parking only
    lanes, speed, kind = ranks.get((arterial, collector), (2, 8.33, "residential"))
    priority = 3 if arterial else 2 if collector else 1
    return f'numLanes="{lanes}" speed="{speed}" type="street.{kind}" priority="{priority}"'
