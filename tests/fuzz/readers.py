"""Every reader of files that come from others, with a valid file for each.

A new reader gets a row here; the tests of this folder do the rest.
"""

import contextlib
import gzip
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import rasterio
import rasterio.transform
import xarray as xr

from glintrack.case.design import Case
from glintrack.core.designs import validate_design
from glintrack.dataset.build import read_about
from glintrack.devices import EtalonDesign, MicromirrorDesign, WireGridDesign
from glintrack.devices.optical_constants import MetalDesign, permittivity
from glintrack.flight.waypoints import read_waypoints
from glintrack.io.detections import read_detections, read_tracks, read_truth
from glintrack.io.heights import read_heights
from glintrack.io.netcdf import read_dataset
from glintrack.io.orthoimages import Geotransform, open_frames
from glintrack.io.photographs import read_camera, read_picture, read_pose
from glintrack.io.raw_mosaics import read_raw
from glintrack.io.toml import read_toml
from glintrack.report import build_page
from glintrack.results import read as results_read
from glintrack.results.read import read_result
from glintrack.scene.materials import load_user_materials
from glintrack.scene.objects.terrain import read_dem
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.read.mesh import read_mesh
from glintrack.scene.read.polygons import read_polygons
from glintrack.scene.read.sumo import read_sumo_net
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.lens import read_lens
from glintrack.sensor.polarizer import load_polarizer
from glintrack.sensor.raw import read_analysers
from glintrack.sensor.response import element_response
from glintrack.study.plan import read_plan
from tests.report.made import write_small_result

_PACKAGED_TRAFFIC = sorted((resources.files("glintrack") / "data" / "traffic").glob("*.nc"))[:1]
EXTENT_M = (-50.0, -50.0, 50.0, 50.0)
WAVELENGTH_UM = np.arange(0.4, 1.01, 0.05)
CRS = "EPSG:32618"


@dataclass(frozen=True)
class Reader:
    """One reader and one format.

    Parameters
    ----------
    name
        Of both.
    suffix
        Ending of its files.
    write
        Writes a valid file.
    read
        Reads one; the value is checked to be finite.
    nan_means_none
        Whether NaN is how the reader says that there is nothing.
    """

    name: str
    suffix: str
    write: Callable[[Path], None]
    read: Callable[[Path], Any]
    nan_means_none: bool = False


def text(content: str) -> Callable[[Path], None]:
    """A writer of a text."""
    return lambda path: _write(path, content.encode())


def _zipped(content: str) -> Callable[[Path], None]:
    return lambda path: _write(path, gzip.compress(content.encode()))


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)


FCD_ROWS = [(0.5 * k, v, "car", 3.0 * k - 20, 5.0 * i, 90.0) for k in range(9) for i, v in enumerate("ab")]
FCD = "timestep_time;vehicle_id;vehicle_type;vehicle_x;vehicle_y;vehicle_angle\n" + "".join(
    ";".join(map(str, row)) + "\n" for row in FCD_ROWS
)
FCD_XML = (
    "<fcd-export>\n"
    + "".join(
        f'<timestep time="{t}">'
        + "".join(
            f'<vehicle id="{v}" type="{k}" x="{x}" y="{y}" angle="{a}"/>\n'
            for u, v, k, x, y, a in FCD_ROWS
            if u == t
        )
        + "</timestep>\n"
        for t in sorted({row[0] for row in FCD_ROWS})
    )
    + "</fcd-export>\n"
)
NET = """<net version="1.20">
  <location netOffset="-100.00,50.00" convBoundary="0,0,1,1" projParameter="+proj=utm +zone=18"/>
  <edge id="a" from="n" to="m" type="highway.residential">
    <lane id="a_0" index="0" speed="13.9" length="100" width="3.5" shape="0,0 50,1 100,0"/>
    <lane id="a_1" index="1" allow="pedestrian" speed="1" length="100" width="2" shape="0,3 100,3"/>
  </edge>
  <junction id="m" type="priority" incLanes="a_0" shape="100,0 104,0 104,4 100,4"/>
  <tlLogic id="t"><phase duration="30" state="G"/><phase duration="4" state="y"/></tlLogic>
  <connection from="a" to="b" fromLane="0" toLane="0" tl="t"/>
</net>
"""
POLY = """<additional>
  <poly id="1" type="building.yes" shape="0,0 20,0 20,15 0,15 0,0">
    <param key="building:levels" value="4"/></poly>
  <poly id="2" type="building" height="12 m" shape="30,0 60,0 60,40 30,40 30,0"/>
  <poly id="3" type="landuse.grass" shape="0,50 90,50 90,90 0,90 0,50"/>
</additional>
"""
OBJ = "o house\nv 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\nv 0 0 20\nf 1 2 3\nf 1 3 4\nf 1 2 5\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n100 0 0\n0 100 0\n100 100 5\n3 0 1 2\n3 1 3 2\n"
)
STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 99 0 0\nvertex 0 99 0\nendloop\nendfacet\n"
    "endsolid a\n"
)
CASE = """name = "mine"
seed = 3
channels = ["pan"]
[scene]
city = "embedded"
[atmosphere]
sun_zenith_deg = 40.0
sun_azimuth_deg = 180.0
[flight]
frames = 4
rate_hz = 2.0
altitude_m = 1928.4
[sensor]
pitch_um = 10.0
focal_length_mm = 40.0
band_um = [0.45, 0.85]
[track.initiation]
confirm_score = 9.0
[track.reporting]
method = "confirmation"
"""
STUDY = 'case = "quickstart"\n[axes]\n"sensor.pitch_um" = [8.5, 10.0]\n"flight.frames" = [4]\n'
SET = (
    'key = "ab"\nversion = "0.1.0"\nshard_frames = 10\n[cases.one]\nsplit = "train"\ncity = "embedded"\n'
    '[cases."two b"]\nsplit = "test"\ncity = "net a"\n'
)
WAYPOINTS = "time_s,east_m,north_m,up_m\n0,0,-2000,1900\n5,100,-1900,1900\n10,200,-1800,1910\n"
KML = (
    '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><LineString><altitudeMode>absolute</altitudeMode>'
    "<coordinates>-77.60,43.10,1900 -77.61,43.11,1900 -77.62,43.12,1910</coordinates>"
    "</LineString></Placemark></kml>"
)
DETECTIONS = "time_s,east_m,north_m,east_var_m2,north_var_m2,red\n" + "".join(
    f"{0.5 * k},{3.0 * k},{5.0},0.25,0.25,{0.1 * k:.1f}\n" for k in range(6)
)
TRACKS = "time_s,track_id,east_m,north_m\n" + "".join(f"{0.5 * k},1,{3.0 * k},5\n" for k in range(6))
TRUTH = "time_s,vehicle_id,east_m,north_m,visible_fraction\n" + "".join(
    f"{0.5 * k},7,{3.0 * k},5,0.9\n" for k in range(6)
)
CAMERA = (
    "focal_length_mm = 50.0\npitch_um = 5.0\nrows = 400\ncolumns = 600\n"
    "[distortion]\nk1 = -0.1\nk2 = 0.01\np1 = 1e-4\n"
)
POSE = (
    'crs = "EPSG:32618"\neasting_m = 287000.0\nnorthing_m = 4780000.0\nheight_m = 900.0\n'
    "heading_deg = 10.0\nroll_deg = 1.0\npitch_deg = -2.0\n"
)
POSES = (
    "name,crs,easting_m,northing_m,height_m,omega_deg,phi_deg,kappa_deg\n"
    "a.tif,EPSG:32618,287000,4780000,900,1,2,90\nb.tif,EPSG:32618,287100,4780000,900,1,2,90\n"
)
CURVE = "wavelength_um,efficiency\n0.35,0.1\n0.5,0.8\n0.9,0.5\n1.1,0.05\n"
SPECTRUM = "# source: made up\nwavelength_um,reflectance\n0.3,0.1\n0.7,0.2\n1.5,\n2.6,0.3\n"
ECOSTRESS = (
    "Name: mud\nX Units: Wavelength (micrometers)\nY Units: Reflectance (percent)\nNumber of X Values: 3\n\n"
    "2.6\t30.5\n1.5\t-1.23e+34\n0.3\t10\n"
)
MOT = "".join(f"{k + 1},1,{10 + k},20,4,6,1,-1,-1,-1\n" for k in range(6))
NK = "# source: made up\nwavelength_um,n,k\n0.3,1.0,2.0\n0.7,2.0,4.0\n2.6,3.0,9.0\n"
MATERIALS = """[mud]
constant = 0.2
refractive_index = 1.5
roughness = 0.3
specular_weight = 0.5
[mesh]
"*" = "mud"
"""
GRID = "period_nm = 200.0\nwire_width_nm = 100.0\nwire_height_nm = 150.0\n"
ETALON = 'name = "e"\n'
MIRROR = 'name = "m"\n[actuator]\nspring_n_per_m = 0.35\n'
LENS = """name = "singlet"
object_distance_mm = 100.0
f_number = 8.0
fields_mm = [[0.0, 0.0], [0.0, 2.0]]
wavelengths_um = [0.5, 0.6]
[[surfaces]]
radius_mm = 50.0
thickness_mm = 5.0
material = "N-BK7"
stop = true
[[surfaces]]
radius_mm = -50.0
thickness_mm = 48.0
"""


def write_dem(path: Path) -> None:
    heights = np.linspace(10, 60, 40 * 40, dtype=np.float32).reshape(40, 40)
    corner = rasterio.transform.from_origin(-200, 200, 10, 10)
    about = {"height": 40, "width": 40, "count": 1, "dtype": "float32", "crs": CRS, "transform": corner}
    with rasterio.open(path, "w", driver="GTiff", compress="deflate", **about) as file:
        file.write(heights, 1)


def write_frame(path: Path) -> None:
    values = np.arange(3 * 24 * 32, dtype=np.float32).reshape(3, 24, 32)
    corner = rasterio.transform.from_origin(287000, 4780000, 1.5, 1.5)
    about = {"height": 24, "width": 32, "count": 3, "dtype": "float32", "crs": CRS, "transform": corner}
    with rasterio.open(path, "w", driver="GTiff", **about) as file:
        file.write(values)
        file.descriptions = ("I", "Q", "U")
        file.update_tags(time_s=0.5)


def write_picture(path: Path) -> None:
    with rasterio.open(path, "w", driver="PNG", height=24, width=32, count=3, dtype="uint8") as file:
        file.write(np.arange(3 * 24 * 32, dtype=np.uint8).reshape(3, 24, 32))


_COUNTS = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)


def write_raw(path: Path) -> None:
    driver = "PNG" if path.suffix == ".png" else "GTiff"
    with rasterio.open(path, "w", driver=driver, height=24, width=32, count=1, dtype="uint16") as file:
        file.write(_COUNTS, 1)


def write_analysers(path: Path) -> None:
    rows = np.tile([[[1.0, 0.9, 0.0]], [[1.1, -0.5, 0.5]]], (4, 6, 1))
    table = {"analyser": (("y", "x", "stokes"), rows), "dark": (("y", "x"), rows[..., 0] + 60)}
    xr.Dataset(table).to_netcdf(path, engine="h5netcdf")


def _calibration(path: Path) -> list:
    found = read_analysers(path)
    return [found.row, found.dark]


def write_stack(path: Path) -> None:
    values = np.arange(4 * 12 * 16, dtype=np.float32).reshape(4, 12, 16)
    coordinates = {"time": np.arange(4) / 2, "y": 100 - 1.5 * np.arange(12), "x": 1.5 * np.arange(16)}
    xr.Dataset({"pan": (("time", "y", "x"), values)}, coordinates).to_netcdf(path, engine="h5netcdf")


def _polarizer(path: Path) -> None:
    um = np.linspace(0.4, 2.5, 22)
    columns = {
        "pass_transmittance": ("wavelength", np.full(22, 0.8)),
        "block_transmittance": ("wavelength", np.full(22, 0.01)),
    }
    xr.Dataset(columns, {"wavelength": ("wavelength", um, {"units": "um"})}).to_netcdf(
        path, engine="h5netcdf"
    )


def _parquet(path: Path) -> None:
    names = ["timestep_time", "vehicle_id", "vehicle_type", "vehicle_x", "vehicle_y", "vehicle_angle"]
    pd.DataFrame(FCD_ROWS, columns=names).to_parquet(path)


def _glb(path: Path) -> None:
    import trimesh

    box = trimesh.creation.box((100, 20, 100))
    path.write_bytes(trimesh.Scene({"house": box}).export(file_type="glb"))


def _frames(path: Path) -> list:
    source = open_frames(path, 2.0, Geotransform(0.0, 100.0, 1.5))
    return [image["pan"].values for _, image in source.frames]


def _folder_of(path: Path) -> list:
    """A folder with this one frame in it."""
    folder = path.parent / f"{path.stem}-frames"
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    (folder / "0.tif").write_bytes(path.read_bytes())
    return _frames(folder)


def _in_a_result(name: str) -> Callable[[Path], Any]:
    """A result folder in which this file has the place of one of its own; what is left is shown as a page.

    The arrays, if they are not what is damaged, are read once: five sixths of the time went into them.
    """
    trees: dict[Path, tuple] = {}

    def kept_arrays(folder: Path):
        if folder not in trees:
            trees[folder] = results_read._read_tree(folder, [])
        return mock.patch.object(results_read, "_read_tree", return_value=trees[folder])

    def read(path: Path) -> Any:
        folder = path.parent / f"{path.stem}-result"
        if not folder.is_dir():
            write_small_result(folder)
        own = folder / name
        kept = own.read_bytes()
        own.write_bytes(path.read_bytes())
        try:
            with kept_arrays(folder) if name != "result.nc" else contextlib.nullcontext():
                result = read_result(folder)
            build_page(result, inline=False)  # facts of provenance are shown as the text they are
            return result.film, result.case, list(result.scores.values())
        finally:
            own.write_bytes(kept)

    return read


def _of_a_result(name: str) -> Callable[[Path], None]:
    """The valid file of that name."""

    def write(path: Path) -> None:
        folder = path.parent / f"{path.stem}-valid"
        if not folder.is_dir():
            write_small_result(folder)
        path.write_bytes((folder / name).read_bytes())

    return write


def _spectrum(path: Path):
    """A material's own spectrum, beside the table that names it."""
    table = path.with_name("materials-of-spectrum.toml")
    table.write_text(f'[mud]\nfile = "{path.name}"\nrefractive_index = 1.5\nroughness = 0.3\n'
                     "specular_weight = 0.5\n")  # fmt: skip
    return load_user_materials(table)[0]


def _recording(path: Path) -> None:
    path.write_bytes(b"".join(p.read_bytes() for p in _PACKAGED_TRAFFIC))


def _moving(path: Path):
    recording = read_fcd(path, EXTENT_M)
    return [recording.at(t) for t in (0.0, recording.duration_s / 2, recording.duration_s)]


def _waypoints(path: Path):
    return read_waypoints(path, CRS, (287000.0, 4780000.0), 100.0, 0.0)


def _curve(path: Path):
    return element_response(SensorDesign(quantum_efficiency=str(path)), WAVELENGTH_UM)


def _metal(path: Path):
    return permittivity(MetalDesign(model="table", table=path), np.array([0.4, 0.6]))


def _heights(path: Path):
    x, y = np.meshgrid([-100.0, 100.0], [-100.0, 100.0])
    return read_heights(path, "--dem", x, y, CRS).values


def _terrain(path: Path):
    return read_dem(path, (-100.0, -100.0, 100.0, 100.0), CRS, (0.0, 0.0))


def _design(model) -> Callable[[Path], Any]:
    return lambda path: validate_design(model, read_toml(path, "design"))


def _fcd(path: Path):
    return read_fcd(path, EXTENT_M)


READERS = (
    Reader("case", ".toml", text(CASE), Case.from_toml),
    Reader("study", ".toml", text(STUDY), read_plan),
    Reader("labelled set", ".toml", text(SET), read_about),
    Reader("wire grid", ".toml", text(GRID), _design(WireGridDesign)),
    Reader("etalon", ".toml", text(ETALON), _design(EtalonDesign)),
    Reader("micromirror", ".toml", text(MIRROR), _design(MicromirrorDesign)),
    Reader("lens", ".toml", text(LENS), lambda path: read_lens(str(path))),
    Reader("materials", ".toml", text(MATERIALS), load_user_materials),
    Reader("traffic, CSV", ".csv", text(FCD), _fcd),
    Reader("traffic, XML", ".xml", text(FCD_XML), _fcd),
    Reader("traffic, zipped XML", ".xml.gz", _zipped(FCD_XML), _fcd),
    Reader("traffic, Parquet", ".parquet", _parquet, _fcd),
    Reader("network", ".net.xml", text(NET), read_sumo_net),
    Reader("zipped network", ".net.xml.gz", _zipped(NET), read_sumo_net),
    Reader("polygons", ".poly.xml", text(POLY), read_polygons),
    Reader("mesh, OBJ", ".obj", text(OBJ), read_mesh),
    Reader("mesh, PLY", ".ply", text(PLY), read_mesh),
    Reader("mesh, STL", ".stl", text(STL), read_mesh),
    Reader("mesh, glTF", ".glb", _glb, read_mesh),
    Reader("DEM", ".tif", write_dem, _terrain),
    Reader("heights", ".tif", write_dem, _heights, nan_means_none=True),
    Reader("waypoints, CSV", ".csv", text(WAYPOINTS), _waypoints),
    Reader("waypoints, KML", ".kml", text(KML), _waypoints),
    Reader("detections", ".csv", text(DETECTIONS), read_detections, nan_means_none=True),
    Reader("tracks", ".csv", text(TRACKS), read_tracks),
    Reader("truth", ".csv", text(TRUTH), read_truth),
    Reader("tracks, MOTChallenge", ".txt", text(MOT), lambda p: read_tracks(p, 2.0, Geotransform(0, 9, 0.5))),
    Reader("camera", ".toml", text(CAMERA), read_camera),
    Reader("pose", ".toml", text(POSE), lambda path: read_pose(path, "a.tif")),
    Reader("poses, CSV", ".csv", text(POSES), lambda path: read_pose(path, "a.tif")),
    Reader("picture", ".png", write_picture, read_picture, nan_means_none=True),
    Reader("frames, GeoTIFF", ".tif", write_frame, _folder_of, nan_means_none=True),
    Reader("frames, NetCDF", ".nc", write_stack, _frames, nan_means_none=True),
    Reader("raw mosaic, TIFF", ".tif", write_raw, read_raw),
    Reader("raw mosaic, PNG", ".png", write_raw, read_raw),
    Reader("raw mosaic, NumPy", ".npy", lambda path: np.save(path, _COUNTS), read_raw),
    Reader("calibration of a camera", ".nc", write_analysers, _calibration, nan_means_none=True),
    Reader("NetCDF", ".nc", _polarizer, lambda path: read_dataset(path, "table"), nan_means_none=True),
    Reader("polarizer", ".nc", _polarizer, lambda path: load_polarizer(SensorDesign(polarizer=str(path)))),
    Reader("recording", ".nc", _recording, _moving),
    Reader("spectrum", ".csv", text(SPECTRUM), _spectrum),
    Reader("spectrum, ECOSTRESS", ".txt", text(ECOSTRESS), _spectrum),
    Reader("result, arrays", ".nc", _of_a_result("result.nc"), _in_a_result("result.nc"), True),
    Reader("result, film", ".json", _of_a_result("film/film.json"), _in_a_result("film/film.json")),
    Reader(
        *("result, provenance", ".toml", _of_a_result("provenance.toml"), _in_a_result("provenance.toml")),
        True,
    ),
    Reader("response curve", ".csv", text(CURVE), _curve),
    Reader("metal", ".csv", text(NK), _metal),
)
