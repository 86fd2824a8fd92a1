"""``glintrack track`` and ``glintrack score`` as somebody with own data meets them."""

import json
import sys
import tomllib

import numpy as np
import pandas as pd
import PIL.Image
import pytest
import rasterio
import xarray as xr
from rasterio.transform import from_origin

from glintrack import metrics
from glintrack.camera import Camera, Pose, ground_points, look_at
from glintrack.cli import app
from glintrack.io.detections import read_detections, read_truth
from glintrack.io.netcdf import write_dataset
from glintrack.io.photographs import PlacedPose, camera_file, pose_file, read_poses
from glintrack.io.toml import to_toml
from glintrack.io.tracks import TRACK_COLUMNS, WRITERS
from glintrack.ortho.posed_frames import rectify_frames
from glintrack.results.froc import froc
from glintrack.track.files import track_detections
from tests.ortho.frames import frame_of
from tests.ortho.test_stabilization import ground as painted_ground
from tests.ortho.test_stabilization import onto_ground, seen


def run(monkeypatch, capsys, *arguments):
    """Exit code, stdout and stderr of the program."""
    monkeypatch.setattr(sys, "argv", ["glintrack", *map(str, arguments)])
    try:
        app.main()
        code = 0
    except SystemExit as stop:
        code = stop.code or 0
    out = capsys.readouterr()
    return code, " ".join(out.out.split()), " ".join(out.err.split())


def crossing(step_s=0.5, count=40, seed=0, sigma=0.4):
    """Two cars that cross, one detection in ten missing, a false one now and then."""
    rng = np.random.default_rng(seed)
    rows, truth = [], []
    for k in range(count):
        t = k * step_s
        for ident, (x, y) in enumerate(((-80 + 8 * t, 3 * np.sin(t / 6)), (40 - 1.0 * t, -70 + 7 * t))):
            truth.append((t, ident, x, y))
            if rng.random() < 0.9:
                rows.append((t, x + rng.normal(0, sigma), y + rng.normal(0, sigma)))
        if rng.random() < 0.5:
            rows.append((t, *rng.uniform(-80, 80, 2)))
    detections = pd.DataFrame(rows, columns=["time_s", "east_m", "north_m"])
    return detections, pd.DataFrame(truth, columns=["time_s", "vehicle_id", "east_m", "north_m"])


def test_strict_tracks_are_all_measured(tmp_path, monkeypatch, capsys):
    """The same detections: no row is coasted, and there are no others than without the option."""
    crossing()[0].to_csv(tmp_path / "d.csv", index=False)
    rows = {}
    for name, option in (("plain", ()), ("strict", ("--strict",))):
        code, _, _ = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / name, *option)
        assert code == 0
        rows[name] = pd.read_csv(tmp_path / name / "tracks.csv")
    assert (rows["strict"]["status"] == "measured").all()
    assert (rows["plain"]["status"] == "coasted").any()
    assert 0.5 < len(rows["strict"]) / len(rows["plain"]) < 1


def test_sweep_of_the_initiation_threshold(tmp_path, monkeypatch, capsys):
    """Asking more of a track lets fewer through: neither true nor false ones become more."""
    detections, truth = crossing()
    detections.to_csv(tmp_path / "d.csv", index=False)
    truth.to_csv(tmp_path / "truth.csv", index=False)
    out, paths = tmp_path / "out", (tmp_path / "d.csv", tmp_path / "truth.csv")
    code, said, _ = run(monkeypatch, capsys, "track", paths[0], "-o", out, "--froc", paths[1])
    assert code == 0 and "froc.csv" in said
    swept = pd.read_csv(out / "froc.csv")
    assert swept["confirm_score"].is_monotonic_increasing
    assert (np.diff(swept["completeness"]) <= 1e-6).all()  # as rounded in the file
    assert swept["false_per_frame"].iloc[-1] <= swept["false_per_frame"].iloc[0]
    assert swept["completeness"].iloc[0] > 0.8 and swept["completeness"].iloc[-1] < 0.8

    lone = froc(read_detections(paths[0], 0.5, None), read_truth(paths[1]), [6.0])[0]
    score = metrics.score_rows(
        track_detections(read_detections(paths[0], 0.5, None)).rows, read_truth(paths[1])
    )
    assert lone["completeness"] == score["completeness"] and lone["purity"] == score["purity"]


def test_detections_to_tracks_to_scores(tmp_path, monkeypatch, capsys):
    detections, truth = crossing()
    detections.to_csv(tmp_path / "d.csv", index=False)
    truth.to_csv(tmp_path / "truth.csv", index=False)
    out = tmp_path / "out"
    code, said, _ = run(
        monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", out, "--sigma-m", 0.4, "--crs", "EPSG:32618"
    )
    assert code == 0 and "wrote" in said and "40 frames" in said
    tracks = pd.read_csv(out / "tracks.csv")
    assert list(tracks.columns) == list(TRACK_COLUMNS)
    assert list(tracks.columns[:4]) == ["time_s", "track_id", "east_m", "north_m"]
    assert {p.name for p in out.iterdir()} == {f"tracks{ending}" for ending in WRITERS}
    assert set(tracks["status"]) <= {"measured", "coasted"}
    assert not tracks.duplicated(["time_s", "track_id"]).any()
    assert all(path.stat().st_size > 0 for path in out.iterdir())
    pd.testing.assert_frame_equal(
        pd.read_parquet(out / "tracks.parquet"), tracks, check_exact=False, rtol=1e-6
    )
    code, said, _ = run(
        monkeypatch,
        capsys,
        "score",
        out / "tracks.csv",
        tmp_path / "truth.csv",
        "--json",
        tmp_path / "s.json",
    )
    scores = json.loads((tmp_path / "s.json").read_text())
    assert code == 0 and f"completeness {scores['completeness']:.6g}" in said
    assert scores["completeness"] > 0.85 and scores["purity"] == 1.0 and scores["identity_switches"] == 0
    assert scores["hota"] > 0.7


def test_order_of_the_rows_of_an_epoch_does_not_matter(tmp_path):
    detections, _ = crossing()
    shuffled = detections.sample(frac=1, random_state=1).sort_values("time_s", kind="stable")

    files = tmp_path / "first.csv", tmp_path / "second.csv"
    for file, table in zip(files, (detections, shuffled), strict=True):
        table.to_csv(file, index=False)
    xr.testing.assert_identical(*(track_detections(read_detections(f)).rows for f in files))


def test_features_tell_two_cars_apart_that_meet(tmp_path):
    """Two cars approach each other unseen and part again on their own sides: they seem to cross."""
    rng = np.random.default_rng(3)
    rows, truth = [], []
    for k in range(56):
        t = 0.25 * k
        for ident, side in enumerate((1, -1)):
            east, north = -80 + 8 * t, side * (0.3 + 6 * abs(np.cos(np.pi * t / 14)))
            truth.append((t, ident, east, north))
            if not 6.0 < t < 8.0:
                looks = 3.0 * side + rng.normal(0, 0.4)
                rows.append(
                    (t, east + rng.normal(0, 0.3), north + rng.normal(0, 0.3), looks, rng.normal(0, 0.4))
                )
    columns = ["time_s", "east_m", "north_m", "f0", "f1"]
    pd.DataFrame(rows, columns=columns).to_csv(tmp_path / "d.csv", index=False)
    pd.DataFrame(truth, columns=["time_s", "vehicle_id", *columns[1:3]]).to_csv(
        tmp_path / "t.csv", index=False
    )
    purity = {}
    for names in (("f0", "f1"), ()):
        followed = track_detections(read_detections(tmp_path / "d.csv", 0.3, names))
        purity[names] = metrics.score_rows(
            followed.rows, read_truth(tmp_path / "t.csv"), match_distance_m=2.0
        )["purity"]
    assert purity["f0", "f1"] > 0.98 and purity[()] < 0.9  # coasting, they pass within a metre


def test_an_index_that_pandas_wrote_is_no_feature(tmp_path):
    detections, _ = crossing()
    for name, index in (("with.csv", True), ("without.csv", False)):
        detections.to_csv(tmp_path / name, index=index)
    names = [read_detections(tmp_path / name).feature_names for name in ("with.csv", "without.csv")]
    assert names[0] == names[1]


def test_nothing_detected_is_fine(tmp_path, monkeypatch, capsys):
    (tmp_path / "d.csv").write_text("time_s,east_m,north_m\n")
    code, said, _ = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out")
    assert code == 0 and "0 tracks" in said
    assert list(pd.read_csv(tmp_path / "out" / "tracks.csv").columns)[:2] == ["time_s", "track_id"]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (
            "time,x,y\n0,1,2\n",
            "must have the columns time_s, east_m, north_m; got no time_s, east_m, north_m",
        ),
        ("", "must have a header row; got the empty file"),
        ("time_s,east_m,north_m\n1,0,0\n0.5,0,0\n", "must not go backwards; got 0.5 after 1 in row 3"),
        (
            "time_s,east_m,north_m\n" + "5,1,0\n-3,1,1\n9,1,2\n" * 4,
            "Is time_s the column of times?",
        ),
        ("time_s;east_m;north_m\n0;1,5;2,5\n", "its columns are separated by semicolons. Use commas"),
        ("time_s,east_m,north_m\n0,nan,0\n", "`east_m` must be finite; got nan in row 2"),
        ("time_s,east_m,north_m\n0,1,inf\n", "`north_m` must be finite; got inf in row 2"),
        ("time_s,east_m,north_m\n0,here,0\n", "`east_m` must hold numbers; got 'here' in row 2"),
        ("time_s,east_m,north_m\n0,1e12,0\n", "must be metres within"),
        (
            "time_s,east_m,north_m\n0,9.1801,48.7758\n0,9.1812,48.7761\n0.5,9.1803,48.7759\n",
            "must be metres; got numbers that look like degrees",
        ),
        (
            "time_s,east_m,north_m,east_var_m2\n0,1,1,1\n",
            "must come with east_var_m2 and north_var_m2; got no north",
        ),
        ("time_s,east_m,north_m,east_var_m2,north_var_m2\n0,1,1,-1,1\n", "must form a positive covariance"),
        ("time_s,east_m,north_m,hue\n0,1,1,5\n1,1,1,red\n", "`hue` must hold numbers; got 'red' in row 3"),
    ],
)
def test_bad_detections_are_one_sentence(tmp_path, monkeypatch, capsys, text, complaint):
    (tmp_path / "d.csv").write_text(text)
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out")
    assert code == 2 and complaint in said and "Traceback" not in said
    assert not (tmp_path / "out").exists() and list(tmp_path.iterdir()) == [tmp_path / "d.csv"]


def test_tracks_at_other_times_than_the_truth(tmp_path, monkeypatch, capsys):
    (tmp_path / "t.csv").write_text("time_s,track_id,east_m,north_m\n0.25,1,0,0\n")
    (tmp_path / "truth.csv").write_text("time_s,vehicle_id,east_m,north_m\n0,1,0,0\n1,1,5,0\n")
    code, _, said = run(monkeypatch, capsys, "score", tmp_path / "t.csv", tmp_path / "truth.csv")
    assert code == 2 and "must have times of the truth" in said


def test_a_stray_detection_far_outside_is_said(tmp_path, monkeypatch, capsys):
    detections, _ = crossing()
    detections.loc[10, "east_m"] = 4e5
    detections.to_csv(tmp_path / "d.csv", index=False)
    code, said, _ = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out")
    assert code == 0 and f"{len(detections)} detections" in said and "1: outside " in said


def test_exchanged_columns_are_told_where_an_area_or_a_map_shows_them(tmp_path, monkeypatch, capsys):
    detections, _ = crossing()
    detections["east_m"] += 1000
    detections.columns = ["time_s", "north_m", "east_m"]
    detections.to_csv(tmp_path / "d.csv", index=False)
    area = ("--area", 880, -120, 1120, 120)
    code, said, _ = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out", *area)
    assert code == 0 and "exchanged most lie inside: are east_m and north_m exchanged?" in said
    detections[["east_m", "north_m"]] += [5792310, 604120]
    detections.to_csv(tmp_path / "d.csv", index=False)
    utm = ("--crs", "EPSG:32632")
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "map", *utm)
    assert code == 2 and "Are east and north exchanged?" in said


def moving_squares(count=24, side=80, gsd=1.5, seed=0):
    """Frames of two bright squares on textured ground."""
    rng = np.random.default_rng(seed)
    ground = 8 + rng.normal(0, 0.6, (side, side))
    for k in range(count):
        frame = ground + rng.normal(0, 0.1, ground.shape)
        for row, column in ((20, 5 + 2.0 * k), (10 + 2.0 * k, 50)):
            r, c = round(row), round(column)
            frame[r : r + 2, c : c + 3] = 20
        yield frame.astype(np.float32)


def write_tiffs(folder, frames, times=None, gsd=1.5, transform=True):
    folder.mkdir()
    for k, frame in enumerate(frames):
        profile = dict(driver="GTiff", height=frame.shape[0], width=frame.shape[1], count=1, dtype="float32")
        if transform:
            profile["transform"] = rasterio.transform.from_origin(5e5, 4e6, gsd, gsd)
            profile["crs"] = "EPSG:32618"
        with rasterio.open(folder / f"f{k:03d}.tif", "w", **profile) as file:
            file.write(frame, 1)
            if times is not None:
                file.update_tags(time_s=times[k])


def test_a_folder_of_geotiffs(tmp_path, monkeypatch, capsys):
    frames = list(moving_squares())
    frames[5][:] = np.nan  # nothing but nodata is no error
    write_tiffs(tmp_path / "frames", frames, np.arange(len(frames)) / 2)
    code, said, _ = run(monkeypatch, capsys, "track", tmp_path / "frames", "-o", tmp_path / "out")
    assert code == 0 and "24 frames" in said and "tracks_lines.kml" in said
    last = pd.read_csv(tmp_path / "out" / "tracks.csv").query("time_s == 11.5")
    # upper left pixels (20, 51) and (56, 50), two rows by three columns: centres in the CRS
    expected = [(5e5 + 1.5 * 52.5, 4e6 - 1.5 * 21), (5e5 + 1.5 * 51.5, 4e6 - 1.5 * 57)]
    for east, north in expected:
        distance = np.hypot(last["east_m"] - east, last["north_m"] - north)
        assert distance.min() < 1.5  # a pixel


def test_a_stack_gives_the_same_tracks_as_the_folder(tmp_path, monkeypatch, capsys):
    frames = list(moving_squares())
    write_tiffs(tmp_path / "frames", frames, np.arange(len(frames)) / 2)
    y, x = 4e6 - 1.5 * (np.arange(80) + 0.5), 5e5 + 1.5 * (np.arange(80) + 0.5)
    stack = xr.Dataset(
        {"pan": (("time", "y", "x"), np.stack(frames))}, coords={"time": np.arange(24) / 2, "y": y, "x": x}
    )
    stack.to_netcdf(tmp_path / "stack.nc", engine="h5netcdf")
    for source, out in (("frames", "a"), ("stack.nc", "b")):
        code, _, said = run(monkeypatch, capsys, "track", tmp_path / source, "-o", tmp_path / out)
        assert code == 0, said
    assert (tmp_path / "a" / "tracks.csv").read_text() == (tmp_path / "b" / "tracks.csv").read_text()


@pytest.mark.parametrize(
    ("make", "extra", "complaint"),
    [
        ({"transform": False}, ("--rate", 2), "must have a geotransform or a world file; got none"),
        ({}, (), "must have a tag time_s or need --rate"),
        ({"times": [0.0, 1.0, 0.5, 2.0]}, (), "must be later than the last frame's 1 s; got 0.5"),
        ({"times": [0.0, 1.0, 1.0, 2.0]}, (), "must be later than the last frame's 1 s; got 1"),
        (
            {"times": [0.0, 1.0, 2.0, 3.0]},
            ("--channel", "dolp"),
            "must be pan for frames without bands I, Q and U",
        ),
        (
            {"times": [0.0, 1.0, 2.0, 3.0]},
            ("--channel", "thermal"),
            "must be 'pan', 'dolp' or 'all'",
        ),
    ],
)
def test_bad_frames_are_one_sentence(tmp_path, monkeypatch, capsys, make, extra, complaint):
    write_tiffs(tmp_path / "frames", list(moving_squares(4)), **make)
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "frames", "-o", tmp_path / "out", *extra)
    assert code == 2 and complaint in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("extra", "complaint"),
    [
        (("--crs", "EPSG:32619"), "`crs` must be the frames' own, EPSG:32618; got EPSG:32619"),
        (("--crs", "EPSG:4326"), "`crs` must be projected and in metres"),
        (("--rate", "inf"), "`rate` must be 0.1 to 1,000 Hz; got inf"),
        (
            ("--area", "0", "0", "9", "9"),
            "`area` must be used with detections or --poses; got 0.0 0.0 9.0 9.0",
        ),
        (("--features", "none"), "`features` must be used with detections; got none"),
        (("--geotransform", "0", "nan", "1"), "`geotransform` must have edges within ±1e+08 m"),
        (("--geotransform", "0", "0", "inf"), "`geotransform` must have edges within ±1e+08 m and pixels"),
    ],
)
def test_frames_are_not_put_elsewhere(tmp_path, monkeypatch, capsys, extra, complaint):
    write_tiffs(tmp_path / "frames", list(moving_squares(3)), [0.0, 1.0, 2.0])
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "frames", "-o", tmp_path / "out", *extra)
    assert code == 2 and complaint in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("second", "complaint"),
    [
        (["EPSG:32618", "EPSG:32619"], "must all have the first one's CRS"),
        (["EPSG:32618", ""], "must all have the first one's CRS"),
        (["EPSG:4326"] * 2, "`crs` must be projected and in metres"),
        (["EPSG:2263"] * 2, "`crs` must be projected and in metres"),
        (["EPSG:3857"] * 2, "`crs` must count metres of the ground"),
    ],
)
def test_frames_lie_in_one_crs_in_metres_of_the_ground(tmp_path, monkeypatch, capsys, second, complaint):
    frames = list(moving_squares(2))
    write_tiffs(tmp_path / "frames", frames, [0.0, 1.0])
    for k, crs in enumerate(second):
        with rasterio.open(tmp_path / "frames" / f"f{k:03d}.tif", "r+") as file:
            file.crs = rasterio.CRS.from_user_input(crs) if crs else rasterio.CRS()
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "frames", "-o", tmp_path / "out")
    assert code == 2 and complaint in said
    assert not (tmp_path / "out").exists()


def test_a_stack_of_degrees_or_without_times_is_refused(tmp_path, monkeypatch, capsys):
    axes = {"time": [0.0, np.nan, 1.0], "y": 10.0 - np.arange(8), "x": np.arange(8.0)}
    stack = xr.Dataset({"pan": (("time", "y", "x"), np.ones((3, 8, 8), np.float32))}, axes)
    stack.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    placed = stack.assign_coords(time=[0.0, 0.5, 1.0]).assign_attrs(crs="EPSG:4326")
    placed.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    for name, complaint in (("a.nc", "`time` must be finite"), ("b.nc", "must be projected and in metres")):
        code, _, said = run(monkeypatch, capsys, "track", tmp_path / name, "-o", tmp_path / "out")
        assert code == 2 and complaint in said


@pytest.mark.parametrize(
    "option", [("--rate", "2"), ("--geotransform", "0", "0", "1"), ("--channel", "dolp")], ids=lambda o: o[0]
)
def test_options_of_frames_are_refused_with_detections(tmp_path, monkeypatch, capsys, option):
    crossing()[0].to_csv(tmp_path / "d.csv", index=False)
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out", *option)
    got = " ".join(f"{float(v):.1f}" if option[0] != "--channel" else v for v in option[1:])
    assert code == 2 and f"`{option[0][2:]}` must be used with frames" in said and f"got {got} for" in said


@pytest.mark.parametrize("option", [("--sigma-m", "inf"), ("--area", "-inf", "-inf", "inf", "inf")])
def test_infinite_options_are_refused(tmp_path, monkeypatch, capsys, option):
    crossing()[0].to_csv(tmp_path / "d.csv", index=False)
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out", *option)
    assert code == 2 and "must be" in said and "inf" in said


def test_frames_that_change_size(tmp_path, monkeypatch, capsys):
    frames = [*moving_squares(3), np.ones((40, 40), np.float32)]
    write_tiffs(tmp_path / "frames", frames, [0.0, 1.0, 2.0, 3.0])
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "frames", "-o", tmp_path / "out")
    assert code == 2 and "must all have the first one's CRS, place and size" in said
    assert "got EPSG:32618 500000, 4000000: 40 × 40 cells" in said and "f003.tif" in said


@pytest.mark.parametrize(
    ("header", "remedy"),
    [
        ("Time_s,East_m,north_m", "Rename Time_s to time_s, East_m to east_m."),
        ("T,East,NORTH_M", "Rename T to time_s, East to east_m, NORTH_M to north_m."),
        ("t,x,y", "Rename t to time_s, x to east_m, y to north_m"),
        ("time_s;east_m;north_m", "Separate the columns by commas"),
        ("time_s,longitude_deg,latitude_deg", "Project them into metres first"),
    ],
)
def test_columns_of_other_names_come_with_a_remedy(header, remedy, tmp_path, monkeypatch, capsys):
    sign = ";" if ";" in header else ","
    (tmp_path / "d.csv").write_text(f"{header}\n{sign.join('123')}\n")
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out")
    assert code == 2 and remedy in said


def test_times_in_milliseconds_are_told(tmp_path, monkeypatch, capsys):
    detections, _ = crossing()
    detections["time_s"] *= 1000
    detections.to_csv(tmp_path / "d.csv", index=False)
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out")
    assert code == 2 and "500 s apart" in said and "is `time_s` in seconds" in said


def test_no_detections_are_told(tmp_path, monkeypatch, capsys):
    (tmp_path / "d.csv").write_text("time_s,east_m,north_m\n")
    code, said, _ = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out")
    assert code == 0 and "no tracks: there are no detections" in said


def test_frames_of_several_loops_are_refused(tmp_path, monkeypatch, capsys):
    write_tiffs(tmp_path / "frames", moving_squares(2), [0.0, 0.5])
    for k, path in enumerate(sorted((tmp_path / "frames").iterdir())):
        path.rename(path.with_name(("all_", "pan_")[k % 2] + path.name))
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "frames", "-o", tmp_path / "out")
    assert code == 2 and "`frames` must be of one channel; got all, pan" in said


def test_kilometres_for_metres_are_asked_about(tmp_path, monkeypatch, capsys):
    rows = [f"{k / 2},{0.01 * k + 0.05 * car},{0.04 * car}" for k in range(10) for car in range(3)]
    (tmp_path / "d.csv").write_text("time_s,east_m,north_m\n" + "\n".join(rows) + "\n")
    code, said, _ = run(monkeypatch, capsys, "track", tmp_path / "d.csv", "-o", tmp_path / "out")
    assert code == 0 and "are east_m and north_m in metres?" in said


def test_frames_of_a_moving_camera_become_tracks_with_one_command(tmp_path, monkeypatch, capsys):
    """Two vehicles on painted ground: each is one track, nothing else is, and the page shows them."""
    pytest.importorskip("cv2")
    ground, folder = painted_ground(), tmp_path / "frames"
    folder.mkdir()
    moments = np.r_[0:5, 6:11]  # one frame is lost
    for k in moments:
        scene = ground.copy()
        for row, column in ((300.0, 240 + 8.0 * k), (250 + 7.0 * k, 340.0)):
            r, c = round(row), round(column)
            scene[r - 2 : r + 3, c - 2 : c + 3] = 255
        PIL.Image.fromarray(seen(scene, onto_ground(k)).clip(0, 255).astype(np.uint8)).save(
            folder / f"{k}.png"
        )
    times = 100 + 0.6 * moments
    (tmp_path / "times.csv").write_text("time_s\n" + "\n".join(map(str, times)))
    ways = ("--stabilize", "--report", "--times", tmp_path / "times.csv", "--geotransform", 0, 0, 1)
    code, said, _ = run(monkeypatch, capsys, "track", folder, "-o", tmp_path / "out", *ways)
    assert code == 0 and "2 tracks over 10 frames" in said and "10 stabilized frames 10" in said
    table = pd.read_csv(tmp_path / "out" / "tracks.csv")
    assert set(table["time_s"]) <= set(times) and (table.groupby("track_id").size() >= 7).all()
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("image/jpeg") == 1 and page.count('<th scope="row">') == 2


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("time_s\n0\n1\n", "`times` must have one row for each frame; got 2 for more frames"),
        ("time_s\n0\n1\n2\n3\n4\n", "`times` must have one row for each frame; got 5 for 4 frames"),
        ("time_s\n0\n2\n1\n3\n", "`times` must be numbers that rise; got 1 after 2 s"),
        ("t\n0\n2\n1\n3\n", "`times` must have a column time_s; got none"),
    ],
)
def test_wrong_times_of_frames_are_one_sentence(text, complaint, tmp_path, monkeypatch, capsys):
    write_tiffs(tmp_path / "frames", list(moving_squares(4)))
    (tmp_path / "t.csv").write_text(text)
    extra = ("-o", tmp_path / "out", "--times", tmp_path / "t.csv")
    code, _, said = run(monkeypatch, capsys, "track", tmp_path / "frames", *extra)
    assert code == 2 and complaint in said and not (tmp_path / "out").exists()


def test_motchallenge_text_keeps_its_frames_and_pixels(tmp_path, monkeypatch, capsys):
    """A car that is not seen in frame 9: its track is in the frames and pixels of the detections."""
    lines = [f"{k},-1,{20 + 8 * k},40,9,5,0.9,-1,-1,-1" for k in range(1, 31) if k != 9]
    (tmp_path / "det.txt").write_text("\n".join(lines))
    frames = ("--rate", 2, "--geotransform", 1000, 2000, 0.5)
    code, said, _ = run(
        monkeypatch, capsys, "track", tmp_path / "det.txt", "-o", tmp_path / "o", *frames, "--sigma-m", 0.3
    )
    assert code == 0 and "29 boxes" in said and "over 30 frames" in said
    frame, _, left, top, wide, high = np.loadtxt(tmp_path / "o" / "tracks_mot.txt", delimiter=",").T[:6]
    assert frame.max() == 30 and len(frame) > 20
    np.testing.assert_allclose(left + wide / 2, 20 + 8 * frame + 4.5, atol=1.0)
    np.testing.assert_allclose(top + high / 2, 42.5, atol=1.0)


LENS = Camera(0.05, 30e-6, 150, 170)
GROUND_M, FLIGHT_CRS, FLIGHT_ORIGIN_M = 120.0, "EPSG:32632", (604000.0, 5792000.0)


def dot_m(time_s):
    """Place of the moving dot from the flight's origin. [m]"""
    return np.array([-40.0 + 11.0 * time_s, 12.0 + 3.0 * time_s])


def counts_at(east_north, time_s):
    """Counts of the ground with its dot at places from the flight's origin. [m]"""
    waves = np.random.default_rng(5).uniform(-0.25, 0.25, (40, 2))
    values = 100 + 4 * np.sin(east_north @ waves.T + np.arange(40)).sum(axis=-1)
    away = np.abs(east_north - dot_m(time_s)) - (2.2, 1.0)
    return np.clip(values + 120 / (1 + np.exp(4 * away.max(axis=-1))), 0, 255)


def write_flight(folder, count=9, step_s=0.5):
    """Frames of a camera that flies, turns and leans over flat ground with a moving dot, and its poses."""
    folder.mkdir()
    (folder.parent / "camera.toml").write_text(camera_file(LENS))
    pixels, poses = np.stack(np.indices((LENS.rows, LENS.columns)), axis=-1).astype(float), []
    for k in range(count):
        pose = look_at(Pose(-60.0 + 8 * k, 180.0, 1120.0), (-10.0 + 6.0 * k, 15.0 - 2.0 * k, GROUND_M))
        east_north = ground_points(LENS, pose, pixels.reshape(-1, 2), GROUND_M)[:, :2]
        image = counts_at(east_north, k * step_s).astype(np.uint8).reshape(LENS.rows, LENS.columns)
        PIL.Image.fromarray(image).save(folder / f"f{k}.png")
        text = pose_file(PlacedPose(pose, FLIGHT_CRS, FLIGHT_ORIGIN_M))
        poses.append({"name": f"f{k}.png", **tomllib.loads(text)})
    table = pd.DataFrame(poses)
    table.to_csv(folder.parent / "poses.csv", index=False)
    return table


def test_frames_with_poses_give_tracks_in_metres_of_the_map(tmp_path, monkeypatch, capsys):
    """The dot's track is where the dot is, in the CRS of the poses, while the camera flies and turns."""
    write_flight(tmp_path / "f")
    ways = ("--camera", tmp_path / "camera.toml", "--poses", tmp_path / "poses.csv", "--height", GROUND_M)
    code, said, wrong = run(
        monkeypatch, capsys, "track", tmp_path / "f", "-o", tmp_path / "out", *ways, "--rate", 2, "--report"
    )
    assert code == 0, wrong
    assert "1 track over 9 frames" in said
    table = pd.read_csv(tmp_path / "out" / "tracks.csv")
    off_m = table[["east_m", "north_m"]].to_numpy() - FLIGHT_ORIGIN_M
    off_m -= np.array([dot_m(time_s) for time_s in table["time_s"]])
    a_pixel_m = 0.6
    assert len(table) >= 8 and np.abs(off_m).max() < 1.5 * a_pixel_m
    assert np.sqrt((off_m**2).mean()) < a_pixel_m
    assert all((tmp_path / "out" / f"tracks{ending}").exists() for ending in WRITERS)


def test_rectified_frames_show_the_ground_where_it_is(tmp_path):
    """Shift of every frame against the closed form, by least squares over its gradients."""
    write_flight(tmp_path / "f", 3)
    files = (tmp_path / name for name in ("f", "camera.toml", "poses.csv"))
    a_fiftieth_of_a_pixel_m, step_m = 0.012, 0.05
    for time_s, image in rectify_frames(*files, GROUND_M, rate_hz=2).frames:
        axes = image["x"].values - FLIGHT_ORIGIN_M[0], image["y"].values - FLIGHT_ORIGIN_M[1]
        places = np.stack(np.meshgrid(*axes), axis=-1)
        steps = np.array([[step_m, 0.0], [0.0, step_m]])
        slopes = [(counts_at(places + s, time_s) - counts_at(places - s, time_s)) / 0.1 for s in steps]
        error = image["pan"].values - counts_at(places, time_s)
        seen_here = np.isfinite(error)
        shift_m, *_ = np.linalg.lstsq(np.stack(slopes, -1)[seen_here], error[seen_here], rcond=None)
        assert seen_here.mean() > 0.3 and np.abs(shift_m).max() < a_fiftieth_of_a_pixel_m


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--poses", "poses.csv", "--height", 120), "`camera` must be given with --poses"),
        (("--poses", "poses.csv", "--camera", "camera.toml"), "must get one of --dem and --height; got none"),
        (
            ("--poses", "short.csv", "--camera", "camera.toml", "--height", 120),
            "must have one row named f3.png",
        ),
        (("--poses", "none", "--camera", "camera.toml", "--height", 120), "folder; got"),
        (("--poses", "f", "--camera", "camera.toml", "--height", 120), "got none for 4 of 4, first f0.pose"),
        (
            ("--poses", "poses.csv", "--camera", "camera.toml", "--height", 1200),
            "frame f0.png: `pose.height_m` must be above the ground",
        ),
        (
            ("--poses", "poses.csv", "--camera", "camera.toml", "--height", 120, "--stabilize"),
            "`stabilize` must be used with frames without --poses",
        ),
        (
            ("--poses", "poses.csv", "--camera", "camera.toml", "--height", 120, "--gsd", 0.05),
            "`area` must have at most 637,500 cells",
        ),
        (
            ("--poses", "poses.csv", "--camera", "camera.toml", "--height", 120, "--area", 0, 0, 100, 100),
            "frame f0.png: `area` and `gsd` must give cells on ground that the frame sees",
        ),
        (
            ("--poses", "poses.csv", "--camera", "camera.toml", "--height", 120, "--times", "times.csv"),
            "`times` must have one row for each frame; got 3 for 4 frames",
        ),
        (("--height", 120), "`height` must be used with --poses"),
    ],
)
def test_wrong_poses_of_frames_are_one_sentence(options, complaint, tmp_path, monkeypatch, capsys):
    table = write_flight(tmp_path / "f", 4)
    table.head(3).to_csv(tmp_path / "short.csv", index=False)
    (tmp_path / "times.csv").write_text("time_s\n0\n1\n2\n")
    monkeypatch.chdir(tmp_path)
    rate = () if "--times" in options else ("--rate", 2)
    code, _, said = run(monkeypatch, capsys, "track", "f", "-o", "out", *options, *rate)
    assert code == 2 and complaint in said and not (tmp_path / "out").exists()


def test_poses_in_a_folder_of_files_are_those_of_the_table(tmp_path):
    write_flight(tmp_path / "f", 3)
    names = [f"f{k}.png" for k in (2, 0)]
    table = pd.read_csv(tmp_path / "poses.csv").set_index("name")
    for name, row in table.iterrows():
        place = {key: (value if isinstance(value, str) else float(value)) for key, value in row.items()}
        (tmp_path / "f" / f"{name[:-4]}.pose.toml").write_text(to_toml(place))
    assert read_poses(tmp_path / "f", names) == read_poses(tmp_path / "poses.csv", names)


def test_frames_of_glintrack_with_pose_files_keep_time_and_polarization(tmp_path):
    """Frames as `glintrack sensor expose` writes them, over a raster of heights."""
    table = write_flight(tmp_path / "f", 3)
    folder = tmp_path / "own"
    folder.mkdir()
    pixels = 2.0 * np.stack(np.indices((LENS.rows // 2, LENS.columns // 2)), axis=-1) + 0.5
    for k, row in enumerate(table.to_dict("records")):
        (folder / f"{k}.pose.toml").write_text(to_toml({key: v for key, v in row.items() if key != "name"}))
        placed = read_poses(folder, [f"{k}.nc"])[0]
        place = ground_points(LENS, placed.pose, pixels.reshape(-1, 2), GROUND_M)[:, :2]
        pan = counts_at(place, 0.5 * k).reshape(pixels.shape[:2]).astype(np.float32)
        stokes = np.stack([pan, 0.1 * pan, 0 * pan], axis=-1)
        write_dataset(folder / f"{k}.nc", frame_of(pan, stokes, time_s=30.0 + 0.5 * k, dolp_floor=0.0))
    west, north = np.array(FLIGHT_ORIGIN_M) + (-500, 500)
    shape = {"height": 2, "width": 2, "count": 1, "dtype": "float32", "crs": FLIGHT_CRS}
    dem = tmp_path / "dem.tif"
    with rasterio.open(
        dem, "w", driver="GTiff", transform=from_origin(west, north, 600, 600), **shape
    ) as file:
        file.write(np.full((1, 2, 2), GROUND_M, np.float32))
    source = rectify_frames(folder, tmp_path / "camera.toml", folder, dem, crs="EPSG:25832", gsd_m=1.0)
    frames = list(source.frames)
    assert source.dolp and source.crs == "EPSG:25832" and [t for t, _ in frames] == [30.0, 30.5, 31.0]
    for _, image in frames:
        known = np.isfinite(image["dolp"].values)
        assert known.mean() > 0.3
        np.testing.assert_allclose(image["dolp"].values[known], 0.1, atol=1e-3)


def rows_of(tmp_path, name, rows, columns=("time_s", "east_m", "north_m")):
    pd.DataFrame(rows, columns=list(columns)).to_csv(tmp_path / name, index=False)
    return track_detections(read_detections(tmp_path / name, 0.3)).rows


@pytest.mark.parametrize("value", ["constant", "status", "empty"])
def test_a_column_that_tells_nothing_changes_no_track(tmp_path, value):
    detections, _ = crossing()
    detections["hue"] = np.random.default_rng(1).normal(0, 1, len(detections))
    detections.to_csv(tmp_path / "one.csv", index=False)
    more = {"constant": 7.0, "status": "seen", "empty": None}[value]
    detections.assign(more=more).to_csv(tmp_path / "two.csv", index=False)
    one, two = (track_detections(read_detections(tmp_path / f"{n}.csv")).rows for n in ("one", "two"))
    assert one.sizes["row"] > 50
    xr.testing.assert_allclose(one, two)


def test_a_track_does_not_wait_through_hours_without_a_detection(tmp_path):
    """A vehicle drives by; ten hours later another does, from where the first was last seen."""
    drive = [(0.5 * k, 5.0 * k, 0.0) for k in range(20)]
    later = [(36000.0 + t, east + 95.0, north) for t, east, north in drive]
    found = rows_of(tmp_path, "d.csv", drive + later)
    first, second = (set(found["track_id"].values[found["time_s"].values // 30000 == k]) for k in (0, 1))
    assert first and second and not first & second


def test_one_missed_frame_at_a_low_rate_is_no_end(tmp_path):
    """Vehicles 40 m apart at 5 m/s and 0.4 Hz; each is missed once."""
    rows = [(2.5 * k, 12.5 * k, 40.0 * n) for k in range(20) for n in range(4) if k != 8 + n]
    found = rows_of(tmp_path, "d.csv", rows)
    assert len(np.unique(found["track_id"].values)) == 4


@pytest.mark.parametrize(("rate_hz", "speed_m_s"), [(1.0, 25.0), (0.5, 20.0), (0.33, 15.0)])
def test_a_lone_vehicle_that_goes_far_between_frames_is_tracked(tmp_path, rate_hz, speed_m_s):
    """Its second detection begins a track of its own, until the third shows that the first goes there."""
    rng = np.random.default_rng(0)
    errors = rng.normal(0, 0.3, (40, 2))
    rows = [(k / rate_hz, speed_m_s * k / rate_hz + e, n) for k, (e, n) in enumerate(errors)]
    found = rows_of(tmp_path, "d.csv", rows)
    assert found.sizes["row"] > 30 and len(np.unique(found["track_id"].values)) == 1
