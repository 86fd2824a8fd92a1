import numpy as np
import pytest

from glintrack.atmosphere import AtmosphereDesign, solve_tables, tables
from glintrack.atmosphere.tables import read_shipped
from glintrack.core.schema import check

SMALL = AtmosphereDesign(
    aerosol="urban",
    sun_zenith_deg=50,
    sun_azimuth_deg=200,
    wavelengths_um=(0.45, 0.65, 0.76),
    altitudes_m=(3000.0,),
    streams=8,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def solved(folder):
    return solve_tables(SMALL, cache=folder)


def test_tables_satisfy_the_schema_and_say_how_they_are_meant(solved):
    check(solved, "atmosphere")
    assert solved.attrs["sun_zenith_rad"] == pytest.approx(np.radians(50))
    assert solved.attrs["sun_azimuth_rad"] == pytest.approx(np.radians(200))
    assert "normal to the beam" in solved["sun_irradiance"].attrs["long_name"]
    assert AtmosphereDesign.model_validate_json(solved.attrs["design"]) == SMALL
    for name in ("sky", "path"):
        assert solved.attrs[f"{name}_intensity_error"] <= 1e-3
        assert solved.attrs[f"{name}_dolp_error"] <= 1e-3


def test_light_is_physical(solved):
    for name in ("sky_radiance", "path_radiance"):
        light = solved[name].values
        assert (light[..., 0] > 0).all()
        assert (np.hypot(light[..., 1], light[..., 2]) <= light[..., 0]).all()


def test_azimuths_are_even_and_periodic_and_the_sky_is_brightest_at_the_sun(solved):
    azimuth = solved["azimuth"].values
    np.testing.assert_allclose(np.diff(azimuth), 2 * np.pi / azimuth.size)
    assert 0 <= azimuth[0] < azimuth[1]
    intensity = solved["sky_radiance"].values[1, :, :, 0]
    row, column = np.unravel_index(intensity.argmax(), intensity.shape)
    assert abs(azimuth[column] - np.radians(200)) < np.radians(2.6)  # half a step
    assert abs(solved["zenith"].values[row] - np.radians(50)) < np.radians(3)


def test_oxygen_darkens_sun_and_path(solved):
    sun = solved["sun_irradiance"].values
    assert sun[2] < 0.75 * sun[1]
    both = sun * solved["transmittance"].values[:, 0, 0]
    assert both[2] < 0.72 * both[1]


def test_second_run_reads_the_cache(folder, solved, monkeypatch):
    monkeypatch.setattr(tables, "solve_in_worker", _refuse)
    again = solve_tables(SMALL, cache=folder)
    assert again.equals(solved)


@pytest.mark.parametrize("damage", ["half", "flipped"])
def test_damaged_cache_is_rebuilt(folder, solved, monkeypatch, damage, tmp_path):
    (good,) = folder.glob("*.nc")
    content = good.read_bytes()
    broken = content[: len(content) // 2] if damage == "half" else content[:-1] + bytes([content[-1] ^ 1])
    (tmp_path / good.name).write_bytes(broken)
    calls = []

    def rebuild(design, scratch, progress, threads):
        calls.append(design)
        answer = scratch / "tables.nc"
        answer.write_bytes(content)
        return answer

    monkeypatch.setattr(tables, "solve_in_worker", rebuild)
    assert solve_tables(SMALL, cache=tmp_path).equals(solved)
    assert calls == [SMALL]
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [content]


def test_default_design_comes_with_the_package(monkeypatch, tmp_path):
    monkeypatch.setattr(tables, "solve_in_worker", _refuse)
    shipped = solve_tables(AtmosphereDesign(), cache=tmp_path)
    assert shipped.sizes["wavelength"] == 61
    assert not list(tmp_path.iterdir())


def test_failed_solve_says_so_and_leaves_no_file(monkeypatch, tmp_path):
    monkeypatch.setattr(tables.sys, "executable", "false")
    with pytest.raises(RuntimeError, match="solving the atmosphere failed"):
        solve_tables(SMALL, cache=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_shipped_tables_are_what_a_fresh_solve_gives(tmp_path):
    design = AtmosphereDesign()
    fresh = tables.with_radiances(_open(tables.solve_in_worker(design, tmp_path)))
    shipped = tables.with_radiances(read_shipped(design))
    fifth_of_truncation = 2e-4  # of I; the order of sums, which threads of BLAS change, moves it by 1e-4
    for name in ("sky_radiance", "path_radiance"):
        scale = fresh[name].values[..., :1]
        assert abs((fresh[name].values - shipped[name].values) / scale).max() < fifth_of_truncation
    np.testing.assert_allclose(fresh["transmittance"], shipped["transmittance"], rtol=fifth_of_truncation)


def _open(path):
    return tables.xr.load_dataset(path, engine="h5netcdf")


def _refuse(*_):
    raise AssertionError("solved again")
