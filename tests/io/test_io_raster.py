"""Rasters written whole or not at all."""

import numpy as np
import pytest

from glintrack.io.envi import header_text
from glintrack.io.raster import SUFFIXES, raster_writer
from glintrack.records import GroundPlace, RasterLayout


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


def test_map_info_of_utm_and_of_another_projection():
    assert "UTM, 1, 1, 1000.0000, 2000.0000, 1.5, 1.5, 18, North, WGS-84" in header_text(
        layout("EPSG:32618"), True
    )
    assert "33, South, WGS-84" in header_text(layout("EPSG:32733"), True)
    text = header_text(layout("EPSG:2056"), False)  # Switzerland's
    assert "map info = {CH1903+ / LV95, 1, 1, 1000.0000" in text and "PROJCS[" in text
