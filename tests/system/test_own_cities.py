"""A mesh with materials, and a city over a raster of heights, flown by ``glintrack run``."""

import math

import numpy as np
import pandas as pd
import pytest
import rasterio
from rasterio.transform import from_origin
from typer.testing import CliRunner

from glintrack.cli.app import app

FLIGHT = """
channels = ["pan"]
[flight]
off_nadir_deg = 20.0
frames = 4
rate_hz = 2.0
[sensor]
rows = 160
columns = 240
oversampling = 1
polarizer = "ideal"
demosaic = "bilinear"
"""


def flown(tmp_path, scene):
    (tmp_path / "case.toml").write_text(f'name = "own"\n{FLIGHT}\n[scene]\n{scene}')
    done = CliRunner().invoke(app, ["run", str(tmp_path / "case.toml"), "-o", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output or done.exception
    assert len(list((tmp_path / "out" / "frames").glob("pan_*.tif"))) >= 1
    return pd.read_parquet(tmp_path / "out" / "truth.parquet")


@pytest.mark.slow
def test_a_mesh_with_materials_is_flown_with_its_traffic(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    plate = trimesh.creation.box(extents=(300, 200, 2))
    plate.apply_translation((0, 0, 1))
    slab = trimesh.creation.box(extents=(40, 60, 3))
    slab.apply_translation((-60, 0, 12))  # a roof high over the street: who is under it is not seen
    scene = trimesh.Scene()
    scene.add_geometry(plate, geom_name="street")
    scene.add_geometry(slab, geom_name="roof")
    scene.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    scene.export(tmp_path / "campus.glb")
    (tmp_path / "map.toml").write_text('[mesh]\nstreet = "asphalt"\nroof = "concrete"\n')
    rows = [
        f"{0.1 * k:.1f};{i};car;{x + k};{y};90"
        for k in range(60)
        for i, x, y in (("a", -62, 0), ("b", 20, 8))
    ]
    head = "timestep_time;vehicle_id;vehicle_type;vehicle_x;vehicle_y;vehicle_angle\n"
    (tmp_path / "fcd.csv").write_text(head + "\n".join(rows))
    keys = 'city = "mesh"\nmesh_file = "campus.glb"\nmaterials_file = "map.toml"\ntraffic_file = "fcd.csv"\n'
    keys += 'area = "window"\n'  # more than the frame
    truth = flown(tmp_path, keys)
    np.testing.assert_allclose(truth["up_m"], 2.0, atol=1e-3)
    first = truth[truth["time_s"] == 0].set_index("vehicle_id")["visible_fraction"]
    assert first[0] == 0 and first[1] > 0.95
    assert (truth["inside"] == 1).all() and (truth["moving"] == 1).all()


@pytest.mark.slow
def test_a_city_over_a_raster_of_heights_is_flown(tmp_path):
    half, cell = 620.0, 10.0
    edge = np.arange(-half + cell / 2, half, cell)
    height = 200 + 0.04 * edge[None, :] + 3 * np.sin(edge[::-1, None] / 90)
    profile = {"driver": "GTiff", "width": edge.size, "height": edge.size, "count": 1, "dtype": "float32"}
    place = from_origin(288000 - half, 4781000 + half, cell, cell)
    with rasterio.open(tmp_path / "dem.tif", "w", crs="EPSG:32618", transform=place, **profile) as file:
        file.write(height.astype(np.float32), 1)
    truth = flown(tmp_path, 'dem_file = "dem.tif"\ntrees = false\n')
    expected = 0.04 * truth["east_m"] + 3 * np.sin(truth["north_m"] / 90)
    np.testing.assert_allclose(truth["up_m"], expected - expected.mean() + truth["up_m"].mean(), atol=0.1)
    slope = (
        0.04 * np.sin(truth["heading_rad"])
        + np.cos(truth["heading_rad"]) * np.cos(truth["north_m"] / 90) / 30
    )
    assert truth["visible_fraction"].max() > 0.9 and math.degrees(math.atan(slope.abs().max())) < 5
