"""What polarized bases (``scene.polarized_bases``) do to the degree of linear polarization of roads.

    python scripts/measure_road_polarization.py

Level ground of the default library, the default atmosphere, seen 50° off nadir at three azimuths from the
sun's, mean of the visible: at the ground, without and with, and at the sensor from 1928 m.
"""

import math
from dataclasses import replace

import numpy as np

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Camera, Pose, look_at
from glintrack.core.spectral import channel_weights
from glintrack.render import shade, trace, unpack_sky
from glintrack.scene import Mesh, Snapshot, load_materials

HEIGHT_M, OFF_NADIR_DEG, VISIBLE_UM, SIDE_M = 1928.0, 50.0, (0.4, 0.7), 20_000.0
NAMES, AZIMUTHS_DEG = ("asphalt", "asphalt_worn", "concrete", "pavement"), (0.0, 90.0, 180.0)


def degrees(name: str, azimuth_deg: float, library, tables) -> tuple[float, float, float]:
    """Phase angle [deg], and the degree at the ground and at the sensor of level ground of a material."""
    sky = unpack_sky(tables, HEIGHT_M)
    airless = replace(sky, path_spectrum=0 * sky.path_spectrum, transmittance=np.ones_like(sky.transmittance))
    um = sky.wavelength_um
    weights = channel_weights(um, ((um >= VISIBLE_UM[0]) & (um <= VISIBLE_UM[1])).astype(float)[None])
    azimuth = tables.attrs["sun_azimuth_rad"] + math.radians(azimuth_deg)
    radius = HEIGHT_M * math.tan(math.radians(OFF_NADIR_DEG))
    pose = look_at(Pose(-radius * math.sin(azimuth), -radius * math.cos(azimuth), HEIGHT_M), [0.0, 0.0, 0.0])
    corners = np.float32([(x, y, 0.0) for y in (-SIDE_M, SIDE_M) for x in (-SIDE_M, SIDE_M)])
    kind = np.full(2, library["material"].values.tolist().index(name), np.int16)
    ground = Mesh(corners, np.int32([[0, 1, 3], [0, 3, 2]]), kind)
    none = np.zeros(0, int)
    scene = Snapshot(ground, (), np.zeros((0, 3, 4)), none, none, none)
    hits = trace(scene, Camera(1.0, 1e-5, 1, 1), pose, sky.sun_direction, library["roughness"].values)
    both = (shade(hits, one, library, weights).values[0, 0, 0].astype(float) for one in (airless, sky))
    phase = math.degrees(math.acos(float(-hits.direction[0] @ sky.sun_direction)))
    return phase, *(math.hypot(q, u) / i for i, q, u in both)


def main() -> None:
    """Print a row a material and azimuth."""
    tables = solve_tables(AtmosphereDesign())
    print("material       azimuth  phase | at the ground, without   with | at the sensor, without   with")
    for name in NAMES:
        for azimuth_deg in AZIMUTHS_DEG:
            (phase, *plain), (_, *own) = (
                degrees(name, azimuth_deg, load_materials(on), tables) for on in (False, True)
            )
            print(f"{name:14s} {azimuth_deg:7.0f} {phase:6.0f} | {plain[0]:22.3f} {own[0]:6.3f} | "
                  f"{plain[1]:22.3f} {own[1]:6.3f}")  # fmt: skip


if __name__ == "__main__":
    main()
