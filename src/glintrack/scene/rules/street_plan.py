"""Street plans of the embedded city: a grid that swings gently, as SUMO's plain nodes and edges."""

from dataclasses import dataclass

import numpy as np

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
        arterial_columns,
        arterial_rows,
        collector_columns,
        collector_rows,
        frozenset(left_out),
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
