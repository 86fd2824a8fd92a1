"""One machine gives one answer, to the last bit: whatever the threads, and over a sky that is kept."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from glintrack.atmosphere import AtmosphereDesign, solve_tables

ROOT = Path(__file__).parents[2]
SKY = {"aerosol": "urban", "sun_zenith_deg": 40.0, "sun_azimuth_deg": 200.0,
       "wavelengths_um": [0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0],
       "streams": 4, "altitudes_m": [500.0, 3000.0]}  # fmt: skip
FLY = """
import sys
from glintrack import Case, run
from glintrack.case import build as scenario
from tests.conftest import ThreeCars, load_materials

scenario.build_scene = lambda design: ThreeCars(load_materials())
run(Case.from_toml(sys.argv[1]), sys.argv[2])
"""
CASE = """name = "three cars"
channels = ["pan", "dolp", "all"]
[atmosphere]
aerosol = "urban"
sun_zenith_deg = 40.0
sun_azimuth_deg = 200.0
wavelengths_um = [0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
streams = 4
altitudes_m = [500.0, 3000.0]
[flight]
off_nadir_deg = 0.0
altitude_m = 3000.0
frames = 8
rate_hz = 2.0
[sensor]
rows = 160
columns = 200
oversampling = 2
polarizer = "ideal"
demosaic = "bilinear"
"""


def test_a_sky_solved_again_is_the_same_to_seven_digits(tmp_path):
    """SASKTRAN2 itself differs in its last bits from call to call; what it gave is read back as it was."""
    design = AtmosphereDesign(**SKY)
    one, three = (solve_tables(design, cache=tmp_path / str(n), threads=n) for n in (1, 3))
    for name, digits in (("sky_radiance", 2e-7), ("path_radiance", 2e-7), ("sky_irradiance", 1e-10)):
        np.testing.assert_allclose(three[name], one[name], rtol=0, atol=digits * float(abs(one[name]).max()))
    xr.testing.assert_identical(one, solve_tables(design, cache=tmp_path / "1"))


@pytest.mark.slow
def test_a_flight_is_the_same_for_any_threads_and_over_a_kept_sky(tmp_path):
    """One thread that solves the sky, then three that read it."""
    (tmp_path / "case.toml").write_text(CASE)
    flown = {}
    for threads in (1, 3):
        named = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
        out = tmp_path / f"flown-{threads}"
        own = {"XDG_CACHE_HOME": str(tmp_path / "cache"), **dict.fromkeys(named, str(threads))}
        words = [sys.executable, "-c", FLY, str(tmp_path / "case.toml"), str(out)]
        ended = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env={**os.environ, **own})
        assert ended.returncode == 0, ended.stderr[-4000:]
        kept = [p for p in out.rglob("*") if p.suffix in (".csv", ".geojson", ".parquet", ".tif", ".webp")]
        flown[threads] = {str(p.relative_to(out)): p.read_bytes() for p in kept}
    assert len(flown[1]["tracks_pan.csv"].splitlines()) > 10
    assert flown[1].keys() == flown[3].keys()
    assert [name for name in flown[1] if flown[1][name] != flown[3][name]] == []
