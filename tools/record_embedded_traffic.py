"""Make src/glintrack/data/traffic/embedded.nc: the embedded city's street network and 120 s of its traffic.

Needs the extra ``traffic``. The street plan `street_plan.SHIPPED_PLAN` is the only input; SUMO's netconvert
gives it lanes, pavements, crossings and signals, and sumo drives on it. Run from the repository's root:
python tools/record_embedded_traffic.py
"""

import argparse
import importlib.metadata
import tempfile
from pathlib import Path

import numpy as np
from shapely.geometry import box

from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.read.sumo import FULL_MIX, NETCONVERT, SumoRun, simulate_traffic
from glintrack.scene.sources.embedded import SHIPPED_PLAN, plan_xml
from glintrack.scene.traffic import Recording, write_recording

OUTPUT = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "traffic" / "embedded.nc"
HALF_EXTENT_M = (330.0, 210.0)
TRAFFIC_MARGIN_M = 30.0
NETWORK_MARGIN_M = 110.0


def main() -> None:
    """Record, keep what the window shows, and write."""
    parser = argparse.ArgumentParser(description="Record the embedded city's traffic.")
    parser.add_argument("--duration-s", type=float, default=120.0, help="length of the recording [s]")
    parser.add_argument(
        "--insertion-period-s", type=float, default=0.44, help="one departure each such interval [s]"
    )
    parser.add_argument("-o", "--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    half_east, half_north = (h + TRAFFIC_MARGIN_M for h in HALF_EXTENT_M)
    with tempfile.TemporaryDirectory() as scratch:
        paths = Path(scratch) / "embedded.nod.xml", Path(scratch) / "embedded.edg.xml"
        for path, text in zip(paths, plan_xml(SHIPPED_PLAN), strict=True):
            path.write_text(text, encoding="utf-8")
        run = SumoRun(
            inputs=paths,
            netconvert=("-n", paths[0].name, "-e", paths[1].name, *NETCONVERT["embedded"]),
            extent_m=(-half_east, -half_north, half_east, half_north),
            origin_m=(0.0, 0.0),
            warmup_s=300.0,
            duration_s=arguments.duration_s,
            insertion_period_s=arguments.insertion_period_s,
            seed=42,
            mix=FULL_MIX,
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
            "source": f"tools/record_embedded_traffic.py with Eclipse SUMO {version}",
            "licence": "BSD-3-Clause, as glintrack; the street plan is the script's own",
            "units": "m and rad in the packed steps each variable names; ENU about the city's centre; "
            "positions are the front bumper's centre, angles clockwise from north",
        },
    )
    traffic = recording.traffic
    for time_s in np.linspace(0, traffic.duration_s, 5):
        _ids, states = traffic.at(float(time_s))
        inside = (np.abs(states[:, 0]) < HALF_EXTENT_M[0]) & (np.abs(states[:, 1]) < HALF_EXTENT_M[1])
        moving = np.hypot(states[:, 3], states[:, 4]) > 0.5
        print(f"t = {time_s:5.1f} s: {inside.sum()} vehicles in the window, {(inside & moving).sum()} moving")
    print(
        f"{arguments.output}: {arguments.output.stat().st_size / 1e6:.2f} MB, {traffic.first.size} vehicles"
    )


if __name__ == "__main__":
    main()
