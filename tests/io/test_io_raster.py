"""Rasters written whole or not at all."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.transform

from glintrack.core.records import GroundPlace, RasterLayout
from glintrack.io.raster import SUFFIXES, raster_writer


def layout(crs=None):
    place = GroundPlace(crs, 1000.0, 2000.0, 1.5) if crs else None
    return RasterLayout(
        "radiance",
        "1",
        4,
        5,
        "",
        ("0.5-0.6 um",),
        "stokes",
        ("I", "Q", "U"),
        (4, 1),
        (0.55,),
        (0.1,),
        "",
        place,
    )


@pytest.mark.parametrize("suffix", [s for s in SUFFIXES if s != ".tiff"])
def test_a_fault_leaves_nothing_and_keeps_what_was_there(tmp_path, suffix):
    path = tmp_path / f"r{suffix}"
    if suffix != ".zarr":
        path.write_text("before")

    def fail_halfway():
        with raster_writer(path, layout()) as write:
            write(0, 0, np.ones((4, 5, 1, 3), np.float32))
            raise RuntimeError("the renderer failed")

    with pytest.raises(RuntimeError, match="the renderer failed"):
        fail_halfway()
    kept = [] if suffix == ".zarr" else [path.name]
    assert [p.name for p in tmp_path.iterdir()] == kept
    assert suffix == ".zarr" or path.read_text() == "before"


@pytest.mark.parametrize("crs", ["EPSG:32618", "EPSG:32733", "EPSG:2056", None])
@pytest.mark.parametrize("block", [(4, 1), (2, 2)])
def test_an_envi_raster_says_all_of_itself(tmp_path, crs, block):
    kind = replace(
        layout(crs), channels=("a", "b"), wavelength_um=(0.55, 0.8), width_um=(0.1, 0.02), block=block
    )
    kind = replace(kind, block=block, stokes_frame="meridian", attributes=(("time_s", 1.5),))
    values = np.arange(4 * 5 * 2 * 3, dtype=np.float32).reshape(4, 5, 2, 3)
    values[0, 0, 0, 0] = np.nan
    rows, channels = block
    with raster_writer(tmp_path / "r.hdr", kind) as write:
        for row in range(0, 4, rows):
            for channel in range(0, 2, channels):
                write(row, channel, values[row : row + rows, :, channel : channel + channels])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r.hdr", "r.img"]
    with rasterio.open(tmp_path / "r.img") as file:
        found = file.read(masked=True).filled(np.nan)
        assert file.descriptions[0].startswith("I a") and file.descriptions[5].startswith("U b")
        said = file.tags(ns="ENVI")
        assert file.tags(2)["wavelength"] == "0.8" and said["wavelength_units"] == "Micrometers"
        assert said["stokes_frame"] == "meridian" and said["time_s"] == "1.5"
        assert said["interleave"] == ("bil" if channels == 2 else "bsq")
        if crs is not None:
            assert pyproj.CRS(file.crs.to_wkt()).to_authority(min_confidence=50) == tuple(crs.split(":"))
            assert file.transform == rasterio.transform.from_origin(1000.0, 2000.0, 1.5, 1.5)
    np.testing.assert_array_equal(found.reshape(3, 2, 4, 5), np.moveaxis(values, (3, 2), (0, 1)))
