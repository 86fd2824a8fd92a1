"""How full vehicles make the elements, and what is left of the signal on the road.

    python scripts/measure_clipping.py [--cases quickstart braunschweig] [--frames 4] [--set KEY=NUMBER ...]

Frames spread evenly over each flight are traced, shaded and brought onto the elements; no tracker flies. An
element is on a moving vehicle, or on the road, if at least half of its rays are. It is full if the
light of its frame would make more electrons than its well holds or its converter counts. Signal to noise of
the road is that of its median element: electrons over the root of the electrons and the dark's variance.
The tables in docs/sensor.md are this command's output.
"""

import argparse
from dataclasses import dataclass

import numpy as np

from glintrack.case.build import Scenario, build_scenario
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.arrays import Array
from glintrack.metrics.definitions import is_moving
from glintrack.render import Hits
from glintrack.scene import City
from glintrack.sensor import dark_noise_e, image_motion, light_on_elements, photo_electrons, smear

HALF = 0.5  # of an element's rays
ROADS = ("asphalt", "asphalt_worn")
QUANTILES = (0.5, 0.9, 0.99, 0.999)


@dataclass(frozen=True)
class Elements:
    """Electrons that the light of some frames makes, by what an element shows and what stands over it."""

    vehicles: dict[str, Array]
    road: dict[str, Array]
    largest_e: float
    dark_e: float


def share_of(hits: Hits, samples: Array) -> Array:
    """(row, column): part of each element's rays that some samples stand for. [1]"""
    whole = np.bincount(hits.element, hits.weight * samples, minlength=hits.rows * hits.columns)
    return whole.reshape(hits.rows, hits.columns)


def masks(hits: Hits, city: City, time_s: float) -> tuple[Array, Array]:
    """Which elements are on moving vehicles, and which on the road."""
    truth = city.truth(time_s)
    moving = truth["vehicle"].values[is_moving(truth)]
    names = [str(name) for name in city.materials["material"].values]
    road = [names.index(name) for name in ROADS if name in names]
    on_road = np.isin(hits.material, road) & (hits.vehicle_id < 0)
    return share_of(hits, np.isin(hits.vehicle_id, moving)) >= HALF, share_of(hits, on_road) >= HALF


def collect(scenario: Scenario, case: Case, count: int) -> Elements:
    """Electrons of some frames of a flight."""
    sensor, flight, observer = scenario.sensor, scenario.flight, scenario.observer
    side = sensor.side
    vehicles: dict[str, list[Array]] = {"pan": [], "polarizer": []}
    road: dict[str, list[Array]] = {"pan": [], "polarizer": []}
    for k in np.linspace(0, len(flight.times_s) - 1, count).round().astype(int):
        t = float(flight.times_s[k])
        pose = flight.pose(t)
        hits = observer.trace(scenario.city.at(t), pose)
        motion = image_motion(sensor.camera, flight.pose, t, 1e-3 * case.sensor.integration_time_ms)
        light = smear(observer.radiance(hits), motion)(sensor.channels).values
        electrons = photo_electrons(light_on_elements(light, sensor), sensor) * sensor.pattern.gain
        on_vehicle, on_road = masks(hits, scenario.city, t)
        for i in range(side):
            for j in range(side):
                kind = "polarizer" if not isinstance(case.sensor.superpixel[i][j], str) else "pan"
                own = (slice(i, None, side), slice(j, None, side))
                vehicles[kind].append(electrons[own][on_vehicle[own]])
                road[kind].append(electrons[own][on_road[own]])
    design = sensor.design
    largest_e = min(design.full_well_e, (2**design.bits - 1) * design.electrons_per_count)
    on_vehicles, on_roads = (
        {kind: np.concatenate(parts or [np.empty(0)]) for kind, parts in of.items()}
        for of in (vehicles, road)
    )
    return Elements(on_vehicles, on_roads, largest_e, dark_noise_e(sensor))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=["quickstart", "braunschweig"])
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=NUMBER")
    given = parser.parse_args()
    changes = {key: float(value) for key, value in (change.split("=") for change in given.set)}
    heads = [f"{q:g}" for q in QUANTILES]
    print(f"| case | elements | on moving vehicles | full | electrons, quantiles {', '.join(heads)} | "
          "road, median | its SNR |")  # fmt: skip
    print("|" + " --- |" * 7)
    for name in given.cases:
        case = Case.from_toml(find_case(name)).replace(changes)
        found = collect(build_scenario(case), case, given.frames)
        for kind, electrons in found.vehicles.items():
            if not len(electrons):
                continue
            full = float((electrons >= found.largest_e).mean())
            median = float(np.median(found.road[kind]))
            snr = median / np.sqrt(median + found.dark_e**2)
            quantiles = ", ".join(f"{1e-3 * np.quantile(electrons, q):.0f} k" for q in QUANTILES)
            print(f"| {name} | {kind} | {len(electrons)} | {100 * full:.2f} % | {quantiles} | "
                  f"{1e-3 * median:.1f} k | {snr:.1f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
