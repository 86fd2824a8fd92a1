"""Make the networks and the recorded traffic of the packaged cases motorway, arterial, junction and suburb.

Needs the extra ``traffic``. Writes ``NAME.net.xml.gz`` and ``NAME.parquet`` (floating-car data with SUMO's
column names) to ``src/glintrack/data/cases/traffic``. ``--seed`` and ``--output`` make other traffic.
Run from the repository's root: python tools/make_traffic_cases.py
"""

import argparse
import gzip
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import sumo

OUTPUT = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "cases" / "traffic"
PROGRAMS = Path(sumo.SUMO_HOME) / "bin"
HALF_EXTENT_M = 420.0, 300.0  # of the recording, more than the window
STEP_S, WARM_UP_S, DURATION_S = 0.1, 180, 60
TYPES = """
<vType id="car" vClass="passenger" length="4.6" sigma="0.3" tau="{tau}" speedFactor="normc(1,.08,.85,1.2)"/>
<vType id="suv" vClass="passenger" length="4.9" sigma="0.3" tau="{tau}" speedFactor="normc(1,.08,.85,1.2)"/>
<vType id="van" vClass="delivery" length="5.8" sigma="0.3" tau="{tau}" speedFactor="normc(.95,.05,.85,1.1)"/>
<vType id="truck" vClass="truck" length="9.5" sigma="0.2" tau="1.2" speedFactor="normc(.85,.03,.8,.9)"/>
<vTypeDistribution id="mix" vTypes="car suv van truck" probabilities="0.68 0.2 0.07 0.05"/>"""


@dataclass(frozen=True)
class Situation:
    """Streets and flows of one kind of traffic.

    Parameters
    ----------
    nodes
        East and north of each node, and its type. [m]
    edges
        From, to, lanes, speed limit [m s⁻¹] and inner points of each edge.
    flows
        Edges of each route and the mean time between its vehicles. [s]
    headway_s
        Time headway of drivers. [s]
    speeds
        Speed limit over time of the edges named by the key, as a slow leader would impose it. [s, m s⁻¹]
    """

    nodes: Mapping[str, tuple[float, float, str]]
    edges: Mapping[str, tuple[str, str, int, float, str]]
    flows: Mapping[str, float]
    headway_s: float = 1.0
    speeds: Mapping[str, tuple[tuple[int, float], ...]] | None = None


def arms(lanes: int, speed_m_s: float) -> dict[str, tuple[str, str, int, float, str]]:
    """Edges from four arms to a junction ``c`` and back."""
    ends = {name: (name, "c") for name in "nesw"}
    inward = {f"{name}i": (*pair, lanes, speed_m_s, "") for name, pair in ends.items()}
    return inward | {f"{name}o": (*pair[::-1], lanes, speed_m_s, "") for name, pair in ends.items()}


def arm_nodes(radius_m: float, kind: str) -> dict[str, tuple[float, float, str]]:
    """Nodes of a junction and its four arms."""
    ends = {"n": (0, 1), "e": (1, 0), "s": (0, -1), "w": (-1, 0)}
    return {"c": (0.0, 0.0, kind), **{k: (radius_m * x, radius_m * y, "") for k, (x, y) in ends.items()}}


def grid(count: int, spacing_m: float, speed_m_s: float) -> tuple[dict, dict]:
    """Nodes and edges of residential streets on a square grid, both ways."""
    half = (count - 1) / 2
    nodes = {
        f"{i}/{j}": ((i - half) * spacing_m, (j - half) * spacing_m, "")
        for i in range(count) for j in range(count)
    }  # fmt: skip
    pairs = [(f"{i}/{j}", f"{i + a}/{j + b}") for i in range(count) for j in range(count)
             for a, b in ((0, 1), (1, 0)) if i + a < count and j + b < count]  # fmt: skip
    return nodes, {
        f"{a}-{b}": (a, b, 1, speed_m_s, "") for one, other in pairs for a, b in ((one, other), (other, one))
    }


def situations() -> dict[str, Situation]:
    """Kinds of traffic by the name of their case."""
    wave = tuple((t, 3.5 if (t // 15) % 3 == 0 else 9.0) for t in range(0, WARM_UP_S + DURATION_S, 15))
    late = tuple((t, 3.0 if (t // 15) % 3 == 1 else 8.0) for t in range(0, WARM_UP_S + DURATION_S, 15))
    turns = {a: [b for b in "nesw" if b != a] for a in "nesw"}
    straight = {"n": "s", "s": "n", "e": "w", "w": "e"}
    nodes, edges = grid(5, 130.0, 8.3)
    ring = [f"{i}/{j}" for i in range(5) for j in range(5)]
    trips = {f"{a}>{b}": 16.0 for a, b in zip(ring, reversed(ring), strict=True) if a != b}
    return {
        "motorway": Situation(
            {"a": (-1500, 180, ""), "b": (1500, -140, "")},
            {
                "east": ("a", "b", 3, 33.3, "-500,70 0,-16 400,-60"),
                "west": ("b", "a", 2, 33.3, "400,-44 0,0 -500,86"),
            },
            {"east": 0.75, "west": 1.1},
            0.7,
        ),
        "arterial": Situation(
            {"a": (-750, -90, ""), "m": (350, 42, ""), "b": (750, 90, ""), "n": (-350, -42, "")},
            {
                "e1": ("a", "m", 2, 13.9, ""), "e2": ("m", "b", 2, 13.9, ""),
                "w1": ("b", "n", 2, 13.9, ""), "w2": ("n", "a", 2, 13.9, ""),
            },
            {"e1 e2": 1.0, "w1 w2": 1.1},
            1.0,
            {"e2": wave, "w2": late},
        ),
        "junction": Situation(
            arm_nodes(600, "traffic_light"),
            arms(3, 13.9),
            {f"{a}i {b}o": 3.2 if straight[a] == b else 9.0 for a, others in turns.items() for b in others},
        ),
        "suburb": Situation(nodes, edges, trips),
    }  # fmt: skip


def run(program: str, *arguments: object) -> None:
    """Run a program of SUMO."""
    subprocess.run([PROGRAMS / program, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


def record(name: str, one: Situation, output: Path, seed: int) -> None:
    """Build a network, simulate its traffic, and write both."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        nodes = [
            f'<node id="{k}" x="{x}" y="{y}" type="{t or "priority"}"/>' for k, (x, y, t) in one.nodes.items()
        ]
        edges = [
            f'<edge id="{k}" from="{a}" to="{b}" numLanes="{n}" speed="{v}"'
            + (
                f' shape="{one.nodes[a][0]},{one.nodes[a][1]} {s} {one.nodes[b][0]},{one.nodes[b][1]}"'
                if s
                else ""
            )
            + "/>"
            for k, (a, b, n, v, s) in one.edges.items()
        ]
        (folder / "n.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
        (folder / "n.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
        net = folder / "n.net.xml"
        run("netconvert", "-n", folder / "n.nod.xml", "-e", folder / "n.edg.xml", "-o", net,
            "--offset.disable-normalization", "--no-turnarounds", "--tls.default-type", "static",
            "--tls.cycle.time", 70)  # fmt: skip
        with gzip.GzipFile(output / f"{name}.net.xml.gz", "wb", mtime=0) as file:
            text = net.read_text()
            file.write((text[: text.index("<!--")] + text[text.index("-->") + 3 :]).encode())

        def lanes(edge: str) -> str:
            return " ".join(f"{edge}_{k}" for k in range(one.edges[edge][2]))

        signs = "".join(
            f'<variableSpeedSign id="v{edge}" lanes="{lanes(edge)}">'
            + "".join(f'<step time="{t}" speed="{v}"/>' for t, v in steps)
            + "</variableSpeedSign>"
            for edge, steps in (one.speeds or {}).items()
        )
        flows = "".join(
            f'<flow id="f{k}" type="mix" begin="0" end="{WARM_UP_S + DURATION_S}" period="exp({1 / period})" '
            f'departLane="best" departSpeed="max" {ends(route)}/>' if ">" in route else
            f'<flow id="f{k}" type="mix" begin="0" end="{WARM_UP_S + DURATION_S}" period="exp({1 / period})" '
            f'departLane="best" departSpeed="max"><route edges="{route}"/></flow>'
            for k, (route, period) in enumerate(one.flows.items())
        )  # fmt: skip
        (folder / "n.add.xml").write_text(f"<additional>{signs}</additional>")
        (folder / "n.rou.xml").write_text(f"<routes>{TYPES.format(tau=one.headway_s)}{flows}</routes>")
        run("sumo", "-n", net, "-r", folder / "n.rou.xml", "-a", folder / "n.add.xml", "--seed", seed,
            "--end", WARM_UP_S + DURATION_S + STEP_S, "--step-length", STEP_S, "--no-step-log",
            "--junction-taz", "--no-warnings", "--time-to-teleport", -1, "--fcd-output", folder / "fcd.xml",
            "--device.fcd.begin", WARM_UP_S, "--device.fcd.period", 0.5)  # fmt: skip
        table = read_rows(folder / "fcd.xml")
    table.to_parquet(output / f"{name}.parquet", compression="zstd", index=False)
    now = table[table.timestep_time == DURATION_S / 2]
    speeds = now.vehicle_speed.quantile([0.1, 0.5, 0.9]).tolist()
    print(f"{name}: {len(now)} vehicles at once, speed {speeds} m/s")


def ends(route: str) -> str:
    """Attributes of a flow between two nodes."""
    first, last = route.split(">")
    return f'fromJunction="{first}" toJunction="{last}"'


def read_rows(path: Path) -> pd.DataFrame:
    """Read the vehicles near the window."""
    rows = []
    for _, element in ElementTree.iterparse(path):
        if element.tag == "timestep":
            time_s = round(float(element.get("time", 0)) - WARM_UP_S, 2)
            for v in element:
                x, y, angle, speed = (float(v.get(k, 0)) for k in ("x", "y", "angle", "speed"))
                if abs(x) < HALF_EXTENT_M[0] and abs(y) < HALF_EXTENT_M[1]:
                    rows.append((time_s, v.get("id"), v.get("type"), x, y, angle, speed))
            element.clear()
    names = ("id", "type", "x", "y", "angle", "speed")
    return pd.DataFrame(rows, columns=["timestep_time", *(f"vehicle_{name}" for name in names)])


def main() -> None:
    """Record all situations."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("-o", "--output", type=Path, default=OUTPUT)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    for name, one in situations().items():
        record(name, one, given.output, given.seed)


if __name__ == "__main__":
    main()
