"""Files of others: what is refused before a parser sees them."""

import gzip
import os
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import rasterio
import rasterio.transform
import xarray as xr

from glintrack.core.records import RasterLayout
from glintrack.io import atomic, images, netcdf, untrusted
from glintrack.io.raster import raster_writer
from glintrack.io.untrusted import check_file, check_heights, check_netcdf, open_raster, plain, read_bytes
from tests.fuzz.disks import mounted

ENDLESS = Path(__file__).parents[1] / "fuzz" / "files" / "endless.nc"  # makes the HDF5 library loop for ever


def test_messages_are_free_of_control_codes():
    assert plain("a\x1b[31mred\x07\n\u202eb") == "a\\x1b[31mred\\x07\n\\u202eb"
    assert plain("größer als 3 µm") == "größer als 3 µm"
    assert len(plain("x" * 9000)) == 2000


def test_what_is_no_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match="`case` must be a readable file"):
        check_file(tmp_path / "none", "case")
    with pytest.raises(ValueError, match=r"which is (a folder|no regular file)"):
        check_file(tmp_path, "case")
    with pytest.raises(ValueError, match="`case` must be a readable file"):
        check_file("a\x00b", "case")
    if os.name == "posix":
        os.mkfifo(tmp_path / "pipe")  # opened, it would wait for ever
        with pytest.raises(ValueError, match=r"which is (a folder|no regular file)"):
            read_bytes(tmp_path / "pipe", "case")


def test_archives_are_bounded(tmp_path):
    path = tmp_path / "a.gz"
    path.write_bytes(gzip.compress(b"one") + gzip.compress(b"two"))
    assert read_bytes(path, "a") == b"onetwo"
    path.write_bytes(gzip.compress(bytes(3_000_000)))
    with pytest.raises(ValueError, match="must unzip to at most 1 MB"):
        read_bytes(path, "a", most_bytes=1_000_000)
    path.write_bytes(gzip.compress(b"one")[:-6])
    with pytest.raises(ValueError, match="must be a whole gzip or bzip2 file"):
        read_bytes(path, "a")


def test_a_whole_netcdf_file_is_read(tmp_path):
    path = tmp_path / "t.nc"
    table = xr.Dataset({"a": ("x", np.arange(5.0)), "s": ("x", list("abcde"))}, {"x": np.arange(5)})
    netcdf.write_dataset(path, table)
    assert netcdf.read_dataset(path, "table").equals(table)


@pytest.mark.parametrize("where", ["a", "x"])
def test_an_infinite_number_in_a_table_is_refused(tmp_path, where):
    path = tmp_path / "t.nc"
    table = xr.Dataset({"a": ("x", np.arange(5.0))}, {"x": np.arange(5.0)})
    changed = table[where].values.copy()
    changed[2] = np.nan  # stands for none
    netcdf.write_dataset(path, table.assign_coords({where: ("x", changed)}))
    netcdf.read_dataset(path, "table")
    changed[2] = np.inf
    netcdf.write_dataset(path, table.assign_coords({where: ("x", changed)}))
    with pytest.raises(ValueError, match=f"`table` must hold finite numbers.* in `{where}`"):
        netcdf.read_dataset(path, "table")


def test_an_endless_file_is_given_up_soon():
    start = time.process_time()
    with pytest.raises(ValueError, match=r"`table` must be a whole NetCDF-4 file.*does not end"):
        netcdf.read_dataset(ENDLESS, "table")
    assert time.process_time() - start < 1.0  # the child's time is not ours


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda f: f.__setitem__("a", h5py.ExternalLink("/etc/passwd", "/")), "links to elsewhere"),
        (lambda f: f.create_dataset("a", (10_000, 10_000, 100), "f4", chunks=True), "says to hold 40000 MB"),
        (
            lambda f: f.create_dataset("a", (8,), "u1", external=[("/etc/passwd", 0, 8)]),
            "its data lie in other files",
        ),
        (lambda f: f.__setitem__("b", f.create_group("a")), "two names"),
    ],
)
def test_hdf5_that_reaches_out_or_swells_is_refused(tmp_path, make, reason):
    path = tmp_path / "t.nc"
    with h5py.File(path, "w") as file:
        make(file)
    with pytest.raises(ValueError, match=reason):
        check_netcdf(path, "table")


def test_text_is_no_netcdf(tmp_path):
    path = tmp_path / "t.nc"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="`table` must be a readable NetCDF-4 file"):
        check_netcdf(path, "table")


def write_raster(path, values, **more):
    height, width = values.shape
    corner = rasterio.transform.from_origin(0, 100, 10, 10)
    about = {"height": height, "width": width, "count": 1, "dtype": values.dtype, "crs": "EPSG:32618"}
    with rasterio.open(path, "w", driver="GTiff", transform=corner, **about, **more) as file:
        file.write(values, 1)


def test_a_virtual_raster_is_not_followed(tmp_path):
    write_raster(tmp_path / "real.tif", np.ones((4, 4), np.float32))
    vrt = tmp_path / "dem.tif"
    vrt.write_text(
        '<VRTDataset rasterXSize="4" rasterYSize="4"><VRTRasterBand dataType="Float32" band="1">'
        "<SimpleSource>"
        '<SourceFilename relativeToVRT="1">real.tif</SourceFilename><SourceBand>1</SourceBand></SimpleSource>'
        "</VRTRasterBand></VRTDataset>"
    )
    with rasterio.open(vrt) as file:  # GDAL by itself reads it
        assert file.read(1).sum() == 16
    with pytest.raises(ValueError, match=r"`--dem` must be a raster \(GeoTIFF"):
        open_raster(vrt, "--dem")


def test_a_raster_larger_than_its_file_is_refused(tmp_path):
    path = tmp_path / "bomb.tif"
    about = {"height": 60_000, "width": 60_000, "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", driver="GTiff", sparse_ok=True, tiled=True, compress="deflate", **about):
        pass
    assert path.stat().st_size < 3_000_000
    with pytest.raises(ValueError, match="must have at most 400,000,000 cells"):
        open_raster(path, "FRAME")


@pytest.mark.parametrize("north", [np.nan, 1e30])
def test_a_raster_that_lies_nowhere_is_refused(tmp_path, north):
    path = tmp_path / "far.tif"
    corner = rasterio.transform.from_origin(0, north, 10, 10)
    about = {"height": 4, "width": 4, "count": 1, "dtype": "uint8", "crs": "EPSG:32618", "transform": corner}
    with rasterio.open(path, "w", driver="GTiff", **about) as file:
        file.write(np.ones((1, 4, 4), np.uint8))
    with pytest.raises(ValueError, match="`--dem` must have a finite geotransform"):
        open_raster(path, "--dem")


def test_heights_that_no_ground_has_are_refused():
    check_heights(np.array([-400.0, 8000.0, np.nan]), "--dem", "a.tif")
    with pytest.raises(ValueError, match=r"`--dem` must hold heights of -500 to 9000 m; got -32768 in 50 %"):
        check_heights(np.array([3.0, -32768.0]), "--dem", "a.tif")


def test_an_output_is_never_written_over(tmp_path):
    path = tmp_path / "a.tif"
    atomic.check_new(path)
    path.write_text("mine")
    with pytest.raises(ValueError, match="`output` must be a new file"):
        atomic.check_new(path)


def test_the_second_run_into_one_folder_is_refused(tmp_path):
    """Also if both have the same process number, as in two containers."""
    path = tmp_path / "out"
    with atomic.result_folder(path) as first:
        (first / "a").write_text("mine")
        with (
            pytest.raises(ValueError, match="must not be written by another run"),
            atomic.result_folder(path),
        ):
            pass
    assert [p.name for p in path.iterdir()] == ["a"]


def test_what_killed_runs_left_is_removed(tmp_path):
    left = tmp_path / ".out.partial-999999999"
    left.mkdir()
    (left / "half.tif").write_text("x")
    with pytest.raises(KeyboardInterrupt), atomic.result_folder(tmp_path / "out"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_link_to_an_empty_folder_is_written_through(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with atomic.result_folder(tmp_path / "link") as folder:
        (folder / "a").write_text("mine")
    assert (tmp_path / "real" / "a").read_text() == "mine"


def test_a_mount_point_is_refused_before_a_run():
    with pytest.raises(ValueError, match=r"got /proc, a mount point"), atomic.result_folder(Path("/proc")):
        pass


def test_a_cache_that_cannot_be_written_costs_no_result(tmp_path):
    from glintrack.io import cache

    (tmp_path / "file").write_text("")
    with pytest.warns(UserWarning, match="cannot be written"):
        assert cache.store("stem", ".nc", tmp_path / "file" / "below", b"data") is None


@pytest.fixture
def full_disk(tmp_path):
    """A file system of 16 kB; skipped where this user may not mount one."""
    with mounted(tmp_path / "disk", "size=16k") as place:
        yield place


def write_whole(path, kind, values):
    with raster_writer(path, kind) as write:
        write(0, 0, values)


def test_a_full_disk_is_an_os_error_and_leaves_nothing(full_disk):
    noise = np.random.default_rng(0).normal(size=(200, 200))
    axes = {"y": np.arange(200.0)[::-1], "x": np.arange(200.0)}
    with pytest.raises(OSError, match="No space left"):
        netcdf.write_dataset(full_disk / "a.nc", xr.Dataset({"a": (("y", "x"), noise)}, axes))
    with pytest.raises(OSError, match="No space left"):
        images.write_bands(
            full_disk / "a.tif", noise[..., None], ["a"], axes["x"], axes["y"], "EPSG:32618", {}
        )
    kind = RasterLayout("r", "1", 200, 200, "", ("a",), "", ("",), (200, 1))
    for name in ("a.hdr", "b.tif"):
        with pytest.raises(OSError), raster_writer(full_disk / name, kind) as write:  # noqa: PT011
            write(0, 0, noise[..., None, None].astype(np.float32))
    with pytest.raises(ValueError, match=r"`output` must be writable; got .*No space left"):
        write_whole(full_disk / "c.nc", kind, noise[..., None, None].astype(np.float32))
    assert list(full_disk.iterdir()) == []


@pytest.fixture
def limit_of_file_sizes():
    """Sets the largest file that this process may write; what lifts it ends with the test."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(("limit", "fits"), [(200_000, False), (1_700_000, False), (2_000_000, True)])
def test_a_cube_in_blocks_is_refused_before_hdf5_runs_out_of_room(tmp_path, limit_of_file_sizes, limit, fits):
    """960 kB of chunks and a reserve of 1 MB; HDF5 ends in a segmentation fault where a file cannot grow."""
    values = np.random.default_rng(0).normal(size=(200, 200, 5, 1)).astype(np.float32)
    kind = RasterLayout("r", "1", 200, 200, "wavelength", tuple("abcde"), "", ("",), (50, 2))
    kind = replace(kind, wavelength_um=(0.4, 0.5, 0.6, 0.7, 0.8))
    path = tmp_path / "c.nc"
    limit_of_file_sizes(limit)
    if fits:
        write_whole(path, kind, values)
        with xr.open_dataset(path, engine="h5netcdf") as file:
            np.testing.assert_array_equal(file["r"].values, np.moveaxis(values[..., 0], 2, 0))
    else:
        with pytest.raises(ValueError, match=r"`output` must be writable; got .*c\.nc: File too large"):
            write_whole(path, kind, values)
        assert list(tmp_path.iterdir()) == []


def test_a_file_probed_once_is_not_probed_again(tmp_path, monkeypatch):
    path = tmp_path / "t.nc"
    netcdf.write_dataset(path, xr.Dataset({"a": ("x", np.arange(3.0))}))
    check_netcdf(path, "table")
    monkeypatch.setattr(untrusted.subprocess, "run", lambda *a, **k: pytest.fail("probed again"))
    check_netcdf(path, "table")


def test_a_file_cut_short_is_refused(tmp_path):
    path = tmp_path / "t.nc"
    netcdf.write_dataset(path, xr.Dataset({"a": ("x", np.arange(3.0))}))
    path.write_bytes(path.read_bytes()[:-900])
    with pytest.raises(ValueError, match="must be a whole NetCDF-4 file"):
        check_netcdf(path, "table")


def test_a_file_that_takes_too_long_is_given_up(monkeypatch):
    untrusted._netcdf_fault.cache_clear()
    monkeypatch.setattr(untrusted, "_WALL_S", 0.5)  # without limits on processor time, as on Windows
    with pytest.raises(ValueError, match="does not end"):
        check_netcdf(ENDLESS, "table")
