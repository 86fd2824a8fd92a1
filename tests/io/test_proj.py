"""A foreign PROJ named by the environment: maps are written all the same, and it is said."""

import os
import subprocess
import sys

import pytest

WRITE = """
import sys
import numpy as np
import xarray as xr
from pathlib import Path
from glintrack.io.images import write_frame
image = xr.Dataset(
    {"pan": (("y", "x"), np.ones((4, 5), "f4")), "dolp": (("y", "x"), np.ones((4, 5), "f4")),
     "stokes_radiance": (("y", "x", "stokes"), np.ones((4, 5, 3), "f4"))},
    coords={"y": np.arange(4.0), "x": np.arange(5.0)}, attrs={"gsd_m": 1.0},
)
write_frame(Path(sys.argv[1]), image, "EPSG:32632", (5e5, 5e6))
import os, rasterio
print(rasterio.open(sys.argv[1]).crs, os.environ.get("PROJ_DATA"))
"""


@pytest.mark.parametrize("name", ["PROJ_DATA", "PROJ_LIB"])
def test_a_foreign_database_costs_no_map(tmp_path, name):
    (tmp_path / "proj.db").write_bytes(b"of another PROJ")
    words = [sys.executable, "-c", WRITE, str(tmp_path / "a.tif")]
    free = {k: v for k, v in os.environ.items() if k not in ("PROJ_DATA", "PROJ_LIB")}
    said = subprocess.run(words, capture_output=True, text=True, env={**free, name: str(tmp_path)})
    assert said.returncode == 0, said.stderr
    assert said.stdout.split() == ["EPSG:32632", "None"]
    assert f"{name}={tmp_path} belongs to another PROJ and is not used" in said.stderr
