"""Make src/glintrack/data/traffic/embedded.nc: the embedded city's street network and 120 s of its traffic.

Needs the extra ``traffic``. The street plan below is the only input; SUMO's netconvert gives it lanes,
pavements, crossings and signals, and sumo drives on it. Run from the repository's root: python
scripts/record_embedded_traffic.py
"""

import argparse
import importlib.metadata
import tempfile
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from shapely.geometry import box

from glintrack.scene.network import RoadNetwork
from glintrack.scene.recording import Recording, write_recording
from glintrack.scene.run_sumo import SumoRun, simulate_traffic

OUTPUT = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "traffic" / "embedded.nc"
HALF_EXTENT_M = (330.0, 210.0)
TRAFFIC_MARGIN_M = 30.0
NETWORK_MARGIN_M = 110.0

# Streets by their line, west to east and south to north. [m]
COLUMNS = (-520, -395, -285, -165, -40, 90, 205, 310, 420, 540)
ROWS = (-400, -270, -165, -70, 40, 135, 230, 390)
PARKING_LANE = '<lane index="0" disallow="all" width="2.2"/>'
ARTERIAL_COLUMNS, ARTERIAL_ROWS = (-40, 310), (40,)
COLLECTOR_COLUMNS, COLLECTOR_ROWS = (-285,), (-165, 230)


def node(column: int, row: int) -> tuple[str, float, float]:
    """Name and place of a crossing; streets swing gently, so that no two run quite alike."""
    x, y = COLUMNS[column], ROWS[row]
    return (
        f"n{column}_{row}",
        x + 9 * np.sin(y / 95) + 4 * np.sin(y / 41 + x),
        y + 8 * np.sin(x / 120) + 4 * np.sin(x / 57 + y),
    )


def street(arterial: bool, collector: bool) -> str:
    """Attributes of a street by its rank."""
    ranks = {(True, False): (2, 13.89, "arterial"), (False, True): (1, 13.89, "collector")}
    # a residential street's second lane is for parking only
    lanes, speed, kind = ranks.get((arterial, collector), (2, 8.33, "residential"))
    priority = 3 if arterial else 2 if collector else 1
    return f'numLanes="{lanes}" speed="{speed}" type="street.{kind}" priority="{priority}"'


def plain_network(folder: Path) -> tuple[Path, Path]:
    """Write nodes and edges as SUMO's plain XML."""
    nodes, edges = ["<nodes>"], ["<edges>"]
    # superblocks: these pieces of street are left out, which makes room for a park, a shopping centre and
    # offices
    left_out = {("h", 4, 3), ("v", 6, 3), ("h", 2, 5)}
    for c in range(len(COLUMNS)):
        for r in range(len(ROWS)):
            name, x, y = node(c, r)
            big = (
                COLUMNS[c] in ARTERIAL_COLUMNS + COLLECTOR_COLUMNS
                and ROWS[r] in ARTERIAL_ROWS + COLLECTOR_ROWS
            )
            inner = 0 < c < len(COLUMNS) - 1 and 0 < r < len(ROWS) - 1
            kind = "traffic_light" if big and inner else "priority"
            nodes.append(f'<node id={quoteattr(name)} x="{x:.2f}" y="{y:.2f}" type="{kind}"/>')
            for axis, c2, r2 in (("h", c + 1, r), ("v", c, r + 1)):
                if c2 >= len(COLUMNS) or r2 >= len(ROWS) or (axis, c, r) in left_out:
                    continue
                line = ROWS[r] if axis == "h" else COLUMNS[c]
                arterial = line in (ARTERIAL_ROWS if axis == "h" else ARTERIAL_COLUMNS)
                collector = line in (COLLECTOR_ROWS if axis == "h" else COLLECTOR_COLUMNS)
                for a, b in ((name, node(c2, r2)[0]), (node(c2, r2)[0], name)):
                    edges.append(
                        f'<edge id="{a}-{b}" from="{a}" to="{b}" {street(arterial, collector)}>'
                        f"{'' if arterial or collector else PARKING_LANE}</edge>"
                    )
    paths = folder / "embedded.nod.xml", folder / "embedded.edg.xml"
    for path, lines, tag in zip(paths, (nodes, edges), ("nodes", "edges"), strict=True):
        path.write_text("\n".join([*lines, f"</{tag}>"]), encoding="utf-8")
    return paths


def main() -> None:
    """Record, keep what the window shows, and write."""
    parser = argparse.ArgumentParser(description="Record the embedded city's traffic.")
    parser.add_argument("--duration-s", type=float, default=120.0, help="length of the recording [s]")
    parser.add_argument(
        "--insertion-period-s", type=float, default=0.46, help="one departure each such interval [s]"
    )
    parser.add_argument("-o", "--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    half_east, half_north = (h + TRAFFIC_MARGIN_M for h in HALF_EXTENT_M)
    with tempfile.TemporaryDirectory() as scratch:
        nodes, edges = plain_network(Path(scratch))
        run = SumoRun(
            inputs=(nodes, edges),
            netconvert=(
                *("-n", nodes.name, "-e", edges.name, "--offset.disable-normalization"),
                *(
                    "--junctions.corner-detail",
                    "5",
                    "--no-turnarounds.except-deadend",
                    "--tls.default-type",
                    "actuated",
                ),
                *("--sidewalks.guess", "--sidewalks.guess.max-speed", "20", "--crossings.guess"),
                *("--default.lanewidth", "3.4", "--default.junctions.radius", "6"),
            ),
            extent_m=(-half_east, -half_north, half_east, half_north),
            origin_m=(0.0, 0.0),
            warmup_s=300.0,
            duration_s=arguments.duration_s,
            insertion_period_s=arguments.insertion_period_s,
            seed=42,
        )
        recording = simulate_traffic(run)
    version = importlib.metadata.version("eclipse-sumo")
    east, north = (h + NETWORK_MARGIN_M for h in HALF_EXTENT_M)
    network: RoadNetwork = recording.network.within(box(-east, -north, east, north))
    write_recording(
        arguments.output,
        Recording(network, recording.traffic),
        {
            "title": "Street network and recorded traffic of glintrack's embedded city",
            "source": f"scripts/record_embedded_traffic.py with Eclipse SUMO {version}",
            "licence": "BSD-3-Clause, as glintrack; the street plan is the script's own",
            "units": "m and rad in the packed steps each variable names; ENU about the city's centre; "
            "positions are the front bumper's centre, angles clockwise from north",
        },
    )
    traffic = recording.traffic
    for time_s in np.linspace(0, traffic.duration_s, 5):
        ids, states = traffic.at(float(time_s))
        inside = (np.abs(states[:, 0]) < HALF_EXTENT_M[0]) & (np.abs(states[:, 1]) < HALF_EXTENT_M[1])
        moving = np.hypot(states[:, 3], states[:, 4]) > 0.5
        print(f"t = {time_s:5.1f} s: {inside.sum()} vehicles in the window, {(inside & moving).sum()} moving")
    print(
        f"{arguments.output}: {arguments.output.stat().st_size / 1e6:.2f} MB, {traffic.first.size} vehicles"
    )


if __name__ == "__main__":
    main()
