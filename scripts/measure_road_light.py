"""What the map of heights does to the light of roads, in the sun and in the shade, in pan.

    python scripts/measure_road_light.py [--city embedded] [--seed 1]

One frame of the default flight. Elements all of whose surface is road without moving vehicles beside it, by
whether the sun reaches them: how many, the mean radiance as rendered over that of probes alone
(`Hits.sky_here` set to one), and the root mean square of each element's ratio less one.
"""

import argparse
from dataclasses import replace

import numpy as np

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.flight import Flight, FlightDesign
from glintrack.render import Observer, unpack_sky
from glintrack.scene import SceneDesign, build_scene
from glintrack.sensor import SensorDesign, build_sensor

ROAD = ("asphalt", "road_paint", "concrete", "pavement")


def main() -> None:
    """Print a row for roads in the sun, and one for those in the shade."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--city", default=SceneDesign().city)
    parser.add_argument("--seed", type=int, default=SceneDesign().seed)
    options = parser.parse_args()
    city = build_scene(SceneDesign(city=options.city, seed=options.seed))
    tables = solve_tables(AtmosphereDesign())
    flight = Flight(FlightDesign(), float(tables.attrs["sun_azimuth_rad"]))
    sky, now = unpack_sky(tables, flight.design.altitude_m), city.at(0.0)
    sensor = build_sensor(SensorDesign(), sky.wavelength_um)
    observer = Observer(city, sky, sensor.camera, now)
    hits = observer.trace(now, flight.pose(0.0))
    alone = replace(hits, sky_view=hits.sky_view / hits.sky_here, sky_here=np.ones_like(hits.sky_here))
    with_map, without = (
        observer.radiance(one)(sensor.pan_weights).values[..., 0].ravel() for one in (hits, alone)
    )
    names = city.materials["material"].values
    road = np.array([name.startswith(ROAD) for name in names])[hits.material] & (hits.material >= 0)
    road &= (hits.sky_left == 255) & (hits.vehicle_id < 0)

    def wholly(samples: np.ndarray) -> np.ndarray:
        """Elements all of whose samples are so."""
        return np.bincount(hits.element, hits.weight * samples, hits.rows * hits.columns) > 0.999

    for name, lit in (("in the sun", hits.sun_visible > 0.99), ("in the shade", hits.sun_visible < 0.01)):
        mine = wholly(road & lit)
        ratio = with_map[mine] / without[mine]
        mean = with_map[mine].mean() / without[mine].mean()
        rms = np.sqrt(((ratio - 1) ** 2).mean())
        print(f"road {name:12s}: {mine.sum()} elements, mean {mean:.4f}, rms of elements {rms:.4f}")


if __name__ == "__main__":
    main()
