"""Raw mosaics from files: every kind gives the counts that were written, other things are one sentence."""

import io

import numpy as np
import pytest
import rasterio
from PIL import Image

from glintrack.io.raw_mosaics import raw_files, read_raw
from glintrack.io.readings import collect_readings

COUNTS = np.arange(8 * 12, dtype=np.uint16).reshape(8, 12) * 37


def write(path, counts, bands=1):
    driver = "PNG" if path.suffix == ".png" else "GTiff"
    about = {"height": counts.shape[-2], "width": counts.shape[-1], "count": bands, "dtype": counts.dtype}
    with rasterio.open(path, "w", driver=driver, **about) as file:
        file.write(counts.reshape(bands, *counts.shape[-2:]))


@pytest.mark.parametrize("suffix", [".tif", ".png", ".npy"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_counts_come_back(tmp_path, suffix, dtype):
    path, counts = tmp_path / f"raw{suffix}", COUNTS.astype(dtype)
    np.save(path, counts) if suffix == ".npy" else write(path, counts)
    found = read_raw(path)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, counts)


def test_pages_are_not_left_out_in_silence(tmp_path):
    pages = [Image.fromarray(COUNTS + k) for k in range(3)]
    pages[0].save(tmp_path / "burst.tif", save_all=True, append_images=pages[1:])
    with pytest.raises(ValueError, match=r"must be a raw mosaic of one picture; got 3 pages .* Split it"):
        read_raw(tmp_path / "burst.tif")


def test_columns_first_and_other_bytes_first(tmp_path):
    np.save(tmp_path / "a.npy", np.asfortranarray(COUNTS.astype(">u2")))
    np.testing.assert_array_equal(read_raw(tmp_path / "a.npy"), COUNTS)


def saved(array, **options):
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (saved(COUNTS.astype(float)), "counts of 8 or 16 bits without sign; got float64"),
        (saved(COUNTS.astype(np.int16)), "counts of 8 or 16 bits without sign; got int16"),
        (saved(COUNTS[None]), r"one mosaic, rows × columns; got \(1, 8, 12\)"),
        (saved(np.array([[{}]], object), allow_pickle=True), "a whole NumPy file"),
        (saved(COUNTS)[:-2], "a whole NumPy file"),
        (saved(COUNTS).replace(b"(8, 12)", b"(8, 99)"), "a whole NumPy file"),
        (b"\x93NUMPY\x09\x00", "a whole NumPy file"),
        (b"", "a whole NumPy file"),
        (saved(np.zeros((0, 4), np.uint8)), "must hold elements; got 0 × 4"),
    ],
)
def test_other_numpy_files_are_refused(tmp_path, data, message):
    path = tmp_path / "a.npy"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=message):
        read_raw(path)


def test_pictures_are_no_raws(tmp_path):
    write(tmp_path / "a.png", np.zeros((3, 8, 8), np.uint8), bands=3)
    with pytest.raises(ValueError, match="must be one mosaic, rows × columns; got 3 bands"):
        read_raw(tmp_path / "a.png")
    (tmp_path / "b.tif").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="`RAW` must be a raw mosaic"):
        read_raw(tmp_path / "b.tif")


def test_folders_are_taken_in_order_and_names_must_differ(tmp_path):
    for name in ("b.tif", "a.npy", "notes.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in raw_files([tmp_path])] == ["a.npy", "b.tif"]
    (tmp_path / "a.png").touch()
    with pytest.raises(ValueError, match="names that differ before the ending; got a twice"):
        raw_files([tmp_path])
    (tmp_path / "none").mkdir()
    with pytest.raises(ValueError, match="must hold raws"):
        raw_files([tmp_path / "none"])


def test_other_files_of_a_folder_are_counted(tmp_path):
    write(tmp_path / "a.tif", COUNTS)
    (tmp_path / "a.raw").write_bytes(bytes(144))
    with collect_readings() as readings:
        assert raw_files([tmp_path]) == [tmp_path / "a.tif"]
    assert (readings[0].found, readings[0].used) == (2, 1)
