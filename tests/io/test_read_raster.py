"""Rasters of all kinds: scale, offset, unit, vertical CRS, ENVI gains, rows that run northward."""

import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from rasterio.transform import Affine, from_origin

from glintrack.io.heights import read_height_range, read_heights
from glintrack.io.orthoimages import open_frames
from glintrack.io.read_raster import length_unit_m, read_raster
from glintrack.io.readings import collect_readings

UTM = "EPSG:32632"
CORNER = from_origin(500000, 5700100, 10, 10)
US_FOOT_M = 1200 / 3937  # NIST SP 811


def write(
    path, values, *, crs=UTM, transform=CORNER, scale=1.0, offset=0.0, unit=None, driver="GTiff", **more
):
    values = np.atleast_3d(values).transpose(2, 0, 1) if values.ndim == 2 else values
    about = {"width": values.shape[2], "height": values.shape[1], "count": len(values), "dtype": values.dtype}
    with rasterio.open(path, "w", driver=driver, crs=crs, transform=transform, **about, **more) as file:
        file.write(values)
        file.scales, file.offsets = (scale,) * len(values), (offset,) * len(values)
        if unit:
            file.units = (unit,) * len(values)
    return path


@pytest.mark.parametrize(
    ("stored", "about"),
    [
        (np.float32(120), {}),
        (np.int16(240), {"scale": 0.5}),
        (np.int16(1200), {"unit": "dm"}),
        (np.uint8(20), {"offset": 100.0}),
        (np.float32(120 / US_FOOT_M), {"unit": "US survey foot"}),
        (np.float32(120 / 0.3048), {"unit": "ft"}),
        (np.float32(120 / US_FOOT_M), {"crs": "EPSG:32632+6360"}),  # NAVD88 height (ftUS)
        (np.float32(120), {"crs": "EPSG:2263", "unit": "m"}),  # feet on the ground, heights in metres
    ],
)
def test_heights_are_metres(tmp_path, stored, about):
    path = write(tmp_path / "d.tif", np.full((10, 10), stored), **about)
    low, high = read_height_range(path, "dem")
    assert low == high == pytest.approx(120, rel=1e-6)


@pytest.mark.parametrize(
    ("about", "complaint"),
    [
        ({"unit": "fathoms of Atlantis"}, "must have heights in a known unit; got 'fathoms of Atlantis'"),
        ({"crs": "EPSG:2263"}, "must state the unit of its heights"),
        ({"crs": "EPSG:32632+5715"}, "must hold heights; got depths"),
        ({"scale": float("inf")}, "must have a finite scale other than 0"),
        ({"photometric": "RGB"}, "must hold heights; got the colours of a picture"),
    ],
)
def test_heights_that_may_be_wrong_are_refused(tmp_path, about, complaint):
    values = np.full((3 if "photometric" in about else 1, 10, 10), 20, np.uint8)
    path = write(tmp_path / "d.tif", values, **about)
    with pytest.raises(ValueError, match=complaint):
        read_height_range(path, "dem")


@pytest.mark.parametrize(
    ("about", "said"),
    [
        ({}, "no unit of height: metres (if they are feet: gdal_edit.py -units ft d.tif)"),
        ({"unit": "m"}, "heights in metres"),
        ({"crs": "EPSG:32632+5773"}, "heights in metres"),  # EGM96 height
        ({"unit": "ft"}, "heights times 0.3048 m"),
    ],
)
def test_the_unit_of_heights_is_said(tmp_path, about, said):
    path = write(tmp_path / "d.tif", np.full((10, 10), 20, np.uint8), **about)
    with collect_readings() as readings:
        read_height_range(path, "dem")
    assert readings[0].notes == (said,)


def test_a_filler_that_is_not_marked_is_found_before_its_scale(tmp_path):
    values = np.full((10, 10), 4000, np.int16)
    values[3, 3] = -9999
    path = write(tmp_path / "d.tif", values, scale=0.01)
    with pytest.raises(ValueError, match=r"must mark missing heights; got -9999"):
        read_height_range(path, "dem")


def test_rows_that_run_northward(tmp_path):
    values = np.arange(100, dtype=np.float32).reshape(10, 10)
    north_up = write(tmp_path / "n.tif", values)
    south_up = write(tmp_path / "s.tif", values[::-1], transform=Affine(10, 0, 500000, 0, 10, 5700000))
    a, b = read_raster(north_up, "frames"), read_raster(south_up, "frames")
    assert a.transform == b.transform and (a.bands == b.bands).all()
    heights = [
        read_heights(p, "dem", np.array([500015.0]), np.array([5700035.0]), UTM) for p in (north_up, south_up)
    ]
    seen = []
    for one in heights:
        column, row = one.to_pixel * (500015.0, 5700035.0)
        seen.append(one.values[round(row), round(column)])
    assert seen == [61.0, 61.0]


def test_gains_of_an_envi_header(tmp_path):
    path = write(tmp_path / "e.img", np.full((2, 4, 5), 100, np.int16), driver="ENVI")
    header = path.with_suffix(".hdr")
    gains = "data gain values = {0.1, 0.2}\ndata offset values = {1, 2}\n"
    header.write_text(header.read_text() + gains)
    raster = read_raster(path, "FRAME")
    np.testing.assert_allclose(raster.bands[:, 0, 0], [11, 22], rtol=1e-6)
    assert raster.dtype == "float32"
    header.write_text(header.read_text().replace(gains, "reflectance scale factor = 10000\n"))
    np.testing.assert_allclose(read_raster(path, "FRAME").bands, 0.01, rtol=1e-6)


@pytest.mark.parametrize(
    ("unit", "metres"), [("feet", 0.3048), ("Meters", 1.0), ("ftUS", US_FOOT_M), ("nm²", None)]
)
def test_names_of_units(unit, metres):
    found = length_unit_m(unit)
    assert found is None if metres is None else found == pytest.approx(metres, rel=1e-12)


def write_stack(path, times, *, rising=False, crs=None, cf=None, units=None, axis_units="m", **encoding):
    y = 5700000.5 + np.arange(6)
    about = {} if units is None else {"units": units}
    frames = np.arange(len(times) * 6 * 8, dtype=np.float32).reshape(-1, 6, 8)
    variable = ("time", "y", "x"), frames, {"grid_mapping": "there"} if crs or cf else {}
    stack = xr.Dataset(
        {"frames": variable},
        coords={
            "time": ("time", np.asarray(times, float), about),
            "y": ("y", y if rising else y[::-1], {"units": axis_units}),
            "x": ("x", 500000.5 + np.arange(8), {"units": axis_units}),
        },
    )
    if crs or cf:
        stack["there"] = xr.DataArray(0, attrs=cf or {"crs_wkt": rasterio.CRS.from_user_input(crs).to_wkt()})
    stack.to_netcdf(path, engine="h5netcdf", encoding={"frames": encoding})
    return path


@pytest.mark.parametrize(
    ("times", "units"),
    [
        (0.5 * np.arange(4), None),
        (500 * np.arange(4), "ms"),
        (500 * np.arange(4), "milliseconds"),
        (0.5 * np.arange(4), "seconds"),
        (0.5 * np.arange(4), "seconds since 2026-05-01"),
    ],
)
def test_times_of_a_stack_are_seconds(tmp_path, times, units):
    source = open_frames(write_stack(tmp_path / "s.nc", times, units=units))
    assert [time for time, _ in source.frames] == [0.0, 0.5, 1.0, 1.5]


@pytest.mark.parametrize(
    ("about", "complaint"),
    [
        ({"times": 500 * np.arange(4)}, "500 s apart .*: is `time` in seconds"),
        ({"times": np.arange(4) / 86400 / 25}, "is `time` in seconds"),
        ({"times": np.arange(4), "units": "fortnights"}, "must be in one of s, sec"),
        ({"times": np.arange(4)[::-1]}, "must not go backwards"),
        ({"crs": "EPSG:2263"}, "must be projected and in metres"),
        ({"crs": "EPSG:4326"}, "must be projected and in metres"),
        ({"crs": "EPSG:3857"}, "must count metres of the ground"),
        ({"cf": {"grid_mapping_name": "flat_earth"}}, "must be a projection of CF"),
        ({"axis_units": "degrees_east"}, "`x` must be in metres; got 'degrees_east'"),
        ({"axis_units": "US_survey_foot"}, "`x` must be in metres"),
    ],
)
def test_stacks_that_would_be_misread_are_refused(tmp_path, about, complaint):
    path = write_stack(tmp_path / "s.nc", **{"times": np.arange(4), **about})
    with pytest.raises(ValueError, match=complaint):
        open_frames(path)


def test_a_stack_has_its_grid_mappings_crs_and_any_direction_of_rows(tmp_path):
    down, up = (
        open_frames(write_stack(tmp_path / f"{k}.nc", range(3), rising=k, crs=UTM)) for k in (False, True)
    )
    assert pyproj.CRS(down.crs) == pyproj.CRS(UTM)
    a, b = next(down.frames)[1], next(up.frames)[1]
    np.testing.assert_array_equal(a["y"], b["y"])
    np.testing.assert_array_equal(a["pan"], b["pan"][::-1])
    cf = open_frames(write_stack(tmp_path / "cf.nc", range(3), cf=pyproj.CRS(UTM).to_cf()))
    assert pyproj.CRS(cf.crs).to_epsg() == 32632


def test_a_scaled_stack(tmp_path):
    packed = {"dtype": "int16", "scale_factor": 0.5, "add_offset": 3.0, "_FillValue": -1}
    plain = next(open_frames(write_stack(tmp_path / "a.nc", range(3))).frames)[1]
    scaled = next(open_frames(write_stack(tmp_path / "b.nc", range(3), **packed)).frames)[1]
    np.testing.assert_allclose(scaled["pan"], plain["pan"], atol=0.25)


def test_no_data_of_one_band_stays_in_that_band(tmp_path):
    """Bands of a push-broom sensor end in different rows; pan of a pixel that lacks one is unknown."""
    bands = np.full((4, 8, 8), 500, np.int16)
    for k in range(4):
        bands[k, : k + 1] = -9999
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", width=8, height=8, count=4, dtype="int16", nodata=-9999
    ) as file:
        file.write(bands)
    found = read_raster(tmp_path / "a.tif", "frames").bands
    assert np.isfinite(found[:, :, 0]).sum(axis=1).tolist() == [7, 6, 5, 4]
    assert np.nanmin(found) == 500
