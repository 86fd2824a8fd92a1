"""What a GIS opens of one run lies one over the other: frames, ways of tracks and vehicles, an ENVI cube."""

import json

import numpy as np
import pyproj
import pytest
import rasterio

from glintrack import simulate
from glintrack.case import build as scenario
from glintrack.io.toml import to_toml
from glintrack.results.recorder import Recorder
from glintrack.results.write import write_result
from glintrack.scene import load_materials
from tests.cli.test_cli import program
from tests.conftest import ThreeCars
from tests.system.test_loop import case

FLIGHT = {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 10}
FRAME = 9
CRS = ("EPSG", "32618")
TO_GEOGRAPHIC = pyproj.Transformer.from_crs("EPSG:32618", "EPSG:4326", always_xy=True)
pytestmark = pytest.mark.slow


@pytest.fixture
def flown(three_cars, tmp_path):
    no_mirror_away = {"query": {"policy": "none"}}  # a served query leaves a hole in pan where its car is
    design = case(flight=FLIGHT, output={"film_frames": 0, "keep_frames": 2}, track=no_mirror_away)
    folder = tmp_path / "result"
    folder.mkdir()
    recorder = Recorder(design, folder)
    tree = simulate(design, recorder.record, on_image=recorder.picture)
    write_result(folder, design, tree, recorder)
    return design, folder


def places_at(path, time_s, ident):
    """Longitude and latitude of every point at a time, as a GIS reads them."""
    features = json.loads(path.read_text())["features"]
    return {
        f["properties"][ident]: f["geometry"]["coordinates"]
        for f in features
        if f["properties"]["time_s"] == time_s
    }


def cell_of(file, longitude, latitude):
    """Row and column of the cell that a point of the map lies in, by the file's own CRS and transform."""
    to_file = pyproj.Transformer.from_crs("EPSG:4326", pyproj.CRS(file.crs.to_wkt()), always_xy=True)
    return file.index(*to_file.transform(longitude, latitude))


def assert_brightest(values, row, column):
    """The cell is on what is brightest within 5 cells: a white car on dark asphalt."""
    about = values[row - 5 : row + 6, column - 5 : column + 6]
    assert values[row, column] > 2 * np.nanmedian(about)
    there = np.unravel_index(np.nanargmax(about), about.shape)
    half_a_car_and_half_a_cell = 2  # 2.25 m and 0.75 m, in cells of 1.5 m
    assert np.abs(np.array(there) - 5).max() <= half_a_car_and_half_a_cell


def test_ways_of_vehicles_and_tracks_lie_on_the_cars_of_the_frame(flown):
    design, folder = flown
    time_s = FRAME / design.flight.rate_hz
    with rasterio.open(folder / "frames" / f"pan_{time_s:07.2f}s.tif") as file:
        assert pyproj.CRS(file.crs.to_wkt()).to_authority(min_confidence=50) == CRS
        assert file.profile["tiled"] or file.shape[0] <= 512  # a small COG is one block
        pan = file.read(1)
        assert file.descriptions[0] == "pan"
        vehicles = places_at(folder / "truth_points.geojson", time_s, "vehicle_id")
        assert sorted(vehicles) == [11, 22, 33]
        cells = {ident: cell_of(file, *place) for ident, place in vehicles.items()}
        for row, column in cells.values():
            assert_brightest(pan, row, column)
        tracks = places_at(folder / "tracks_pan_points.geojson", time_s, "track_id")
        assert len(tracks) == 3
        for place in tracks.values():
            row, column = cell_of(file, *place)
            nearest = min(max(abs(row - r), abs(column - c)) for r, c in cells.values())
            assert nearest <= 1  # the tracker's own error: a superpixel


def test_an_envi_cube_of_the_same_frame_lies_there_too(flown, monkeypatch, tmp_path):
    spectral = pytest.importorskip("spectral", reason="needs the dev extra")
    design, folder = flown
    monkeypatch.setattr(scenario, "build_scene", lambda _: ThreeCars(load_materials()))
    path = tmp_path / "flown.toml"
    path.write_text(to_toml(design))
    asked = ["--frame", FRAME, "--cube", "--band", "0.5:0.6", "--ortho", "-o", tmp_path / "cube.hdr"]
    assert program(monkeypatch, "render", path, *asked) == 0
    image = spectral.open_image(str(tmp_path / "cube.hdr"))
    # the header's own words, as a user prints them
    assert 'PROJCS["WGS_1984_UTM_Zone_18N"' in ",".join(image.metadata["coordinate system string"])
    corner = [float(v) for v in image.metadata["map info"][3:7]]
    city = ThreeCars(load_materials())
    assert corner == [288000.0 + city.extent_m[0], 4781000.0 + city.extent_m[3], 1.5, 1.5]
    time_s = FRAME / design.flight.rate_hz
    with rasterio.open(tmp_path / "cube.img") as file:  # GDAL
        assert pyproj.CRS(file.crs.to_wkt()).to_authority(min_confidence=50) == CRS
        first = file.read(1)
        for place in places_at(folder / "truth_points.geojson", time_s, "vehicle_id").values():
            row, column = cell_of(file, *place)
            assert_brightest(first, row, column)
            assert image[row, column].ravel()[0] == first[row, column]
