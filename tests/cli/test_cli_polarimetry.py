"""``glintrack polarimetry`` as somebody with a polarization camera meets it, on to tracks."""

import sys

import numpy as np
import pandas as pd
import pytest
import rasterio
import xarray as xr

from glintrack.cli import app
from glintrack.core.schema import check

SIDE = 192  # elements
CAMERA = ("--black", 100, "--rate", 4, "--dark-noise", 12, "--demosaic", "superpixel")


@pytest.fixture
def run(monkeypatch, capsys):
    """Exit code, stdout and stderr of the program."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["glintrack", *map(str, arguments)])
        try:
            app.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        out = capsys.readouterr()
        return code, " ".join(out.out.split()), " ".join(out.err.split())

    return call


def mosaic(total, q=0.0, u=0.0):
    """Counts of a Polarsens mosaic of light that is even over each superpixel."""
    angle = np.radians([[90.0, 45.0], [135.0, 0.0]])
    tile = tuple(np.tile(f(2 * angle), (SIDE // 2, SIDE // 2)) for f in (np.cos, np.sin))
    return total * (1 + q * tile[0] + u * tile[1])


def road(frame, paint, seed=0):
    """A level road with texture, two cars of 6 × 3 superpixels that drive across it, polarized as painted."""
    rng = np.random.default_rng(seed)
    coarse = 6000 + 900 * rng.standard_normal((SIDE // 2, SIDE // 2))
    total, q = coarse, np.full_like(coarse, 0.02)
    for row, start, step in ((30, 8, 3), (60, 80, -3)):
        x = start + step * frame
        total[row : row + 3, x : x + 6] *= paint[0]
        q[row : row + 3, x : x + 6] = paint[1]
    noise = np.random.default_rng([seed, frame]).normal(0, 12, (SIDE, SIDE))
    grown = (np.repeat(np.repeat(v, 2, axis=0), 2, axis=1) for v in (total, q))
    return np.rint(mosaic(*grown) + 100 + noise).astype(np.uint16)


def test_raws_of_every_kind_become_files_and_pictures(run, tmp_path):
    counts = np.rint(mosaic(9000.0, 0.3, -0.1)).astype(np.uint16)
    np.save(tmp_path / "a.npy", counts)
    with rasterio.open(
        tmp_path / "b.png", "w", driver="PNG", height=SIDE, width=SIDE, count=1, dtype="uint16"
    ) as file:
        file.write(counts, 1)
    out = tmp_path / "out"
    code, said, _ = run("polarimetry", tmp_path / "a.npy", tmp_path / "b.png", "-o", out, "--rate", 4)
    assert code == 0 and "median DoLP 0.316" in said and "2 frames" in said
    assert sorted(p.name for p in out.iterdir()) == sorted(
        f"{stem}{end}" for stem in "ab" for end in (".nc", ".tif", "_aop.png", "_dolp.png", "_s0.png")
    )
    with xr.open_dataset(out / "b.nc", engine="h5netcdf") as opened:
        frame = check(opened.load(), "frame")
    assert frame.attrs["time_s"] == 0.25
    with rasterio.open(out / "b.tif") as file:
        assert file.descriptions == ("pan", "I", "Q", "U", "dolp", "aop") and file.tags()["time_s"] == "0.25"
        assert file.units == (*["count"] * 4, "1", "rad")
        np.testing.assert_array_equal(file.read(5), frame["dolp"])
    np.testing.assert_allclose(frame["dolp"], np.hypot(0.3, 0.1), atol=2e-4)


@pytest.mark.parametrize("channel", ["pan", "dolp"])
def test_cars_before_a_fixed_camera_are_tracked(run, tmp_path, channel):
    """In pan by their brightness; in DoLP by their polarization alone, their S0 being the road's.

    Light is even over superpixels, so that they are taken as they lie.
    """
    raws = tmp_path / "raws"
    raws.mkdir()
    paint = (1.6, 0.02) if channel == "pan" else (1.0, 0.25)
    for k in range(12):
        np.save(raws / f"{k:02d}.npy", road(k, paint))
    code, _, _ = run("polarimetry", raws, "-o", tmp_path / "p", *CAMERA)
    assert code == 0
    options = ("--geotransform", 0, 0, 1.0, "--channel", channel)
    code, _, err = run("track", tmp_path / "p", "-o", tmp_path / "t", *options)
    assert code == 0, err
    rows = pd.read_csv(tmp_path / "t" / "tracks.csv")
    last = rows[rows["time_s"] == rows["time_s"].max()].sort_values("north_m")
    two_pixels_m = 2.0
    assert len(last) == 2
    np.testing.assert_allclose(last["north_m"], [-61.5, -31.5], atol=two_pixels_m)
    np.testing.assert_allclose(last["east_m"], [80 - 33 + 3, 8 + 33 + 3], atol=two_pixels_m)
    np.testing.assert_allclose(last["east_speed_m_s"], [-12, 12], atol=3)


def test_frames_with_poses_are_rectified_and_tracked(run, tmp_path):
    """Straight down from 1000 m, a superpixel 1 m: the same two cars, on the map."""
    raws = tmp_path / "raws"
    raws.mkdir()
    for k in range(10):
        np.save(raws / f"{k:02d}.npy", road(k, (1.6, 0.02)))
    assert run("polarimetry", raws, "-o", tmp_path / "p", *CAMERA)[0] == 0
    (tmp_path / "camera.toml").write_text(
        f"focal_length_mm = 10.0\npitch_um = 5.0\nrows = {SIDE}\ncolumns = {SIDE}\n", encoding="utf-8"
    )
    (tmp_path / "poses.csv").write_text(
        "name,crs,easting_m,northing_m,height_m,heading_deg,roll_deg,pitch_deg\n"
        + "".join(f"{k:02d},EPSG:32618,287000,4780000,1000,0,0,0\n" for k in range(10)),
        encoding="utf-8",
    )
    (tmp_path / "r").mkdir()
    for k in range(10):
        code, _, err = run(
            "ortho", tmp_path / "p" / f"{k:02d}.nc", "--camera", tmp_path / "camera.toml",
            "--pose", tmp_path / "poses.csv", "--height", 0, "--gsd", 1,
            "--area", 286956, 4779956, 287044, 4780044, "-o", tmp_path / "r" / f"{k:02d}.tif",
        )  # fmt: skip
        assert code == 0, err
    code, _, err = run("track", tmp_path / "r", "-o", tmp_path / "t", "--rate", 4)
    assert code == 0, err
    rows = pd.read_csv(tmp_path / "t" / "tracks.csv")
    last = rows[rows["time_s"] == rows["time_s"].max()].sort_values("north_m")
    two_pixels_m = 2.0
    assert len(last) == 2
    np.testing.assert_allclose(last["north_m"] - 4780000, [48 - 61.5, 48 - 31.5], atol=two_pixels_m)
    np.testing.assert_allclose(
        last["east_m"] - 287000, [80 - 27 + 3 - 48, 8 + 27 + 3 - 48], atol=two_pixels_m
    )


def written(folder, **arrays):
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return [folder / f"{name}.npy" for name in arrays]


GOOD = np.full((8, 8), 100, np.uint16)


@pytest.mark.parametrize(
    ("arrays", "options", "message"),
    [
        ({"a": GOOD[:7]}, (), "`RAW` must have even rows"),
        ({"a": GOOD, "b": GOOD.astype(np.uint8)}, (), "one bit depth, 16 bits as a.npy; got 8 bits"),
        ({"a": GOOD, "b": np.full((8, 6), 100, np.uint16)}, (), "one size, 8 × 8 as a.npy; got 8 × 6"),
        ({"a": np.full((8, 8), 65535, np.uint16)}, (), "at most 5 % of its elements full, at 65535"),
        ({"a": GOOD}, ("--white", 90), "at most 5 % of its elements full, at 90 counts"),
        ({"a": GOOD}, ("--black", 90, "--white", 80), "`white_level` must be above black_level, 90 counts"),
        ({"a": GOOD.astype(np.uint8)}, ("--black", 300), "`black_level` must be below that of a full"),
        ({"a": GOOD}, ("--layout", "135-0"), "`layout` must be one of mirror-0-60-120, 0-45-90-135"),
        ({"a": GOOD}, ("--layout", "0 x / 45 90"), "`layout` must hold 'mirror', 'open', angles in degrees"),
        ({"a": GOOD}, ("--calibration", "none.nc"), "`calibration` must be a readable file; got none.nc"),
        ({"a": GOOD}, ("--saturated", 2), "`max_saturated` must be"),
        ({"a": GOOD}, ("--rate", 0), "`--rate` must be greater than or equal to 0.001 Hz; got 0 Hz"),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence_and_leaves_nothing(run, tmp_path, arrays, options, message):
    out = tmp_path / "out"
    code, _, err = run("polarimetry", *written(tmp_path, **arrays), "-o", out, *options)
    assert code == 2 and message in err and err.count("glintrack:") == 1
    assert not [p for p in tmp_path.iterdir() if p.suffix != ".npy"]
