"""`glintrack score` asks what is wrong where hardly a track is a vehicle's."""

import pandas as pd
import pytest

from glintrack import score
from glintrack.cli import app


@pytest.fixture
def files(tmp_path):
    """Three cars over twenty seconds, and tracks that are exactly they."""
    rows = [(t, v, -150.0 + 10 * t, 40.0 + 5 * v * t) for t in range(20) for v in range(3)]
    places = pd.DataFrame(rows, columns=["time_s", "vehicle_id", "east_m", "north_m"])
    places.to_csv(tmp_path / "truth.csv", index=False)
    return places.rename(columns={"vehicle_id": "track_id"}), tmp_path


@pytest.mark.parametrize(
    ("change", "asked"),
    [
        (lambda t: t, None),
        (lambda t: t.assign(east_m=t.east_m + 12, track_id=t.track_id + 100 * t.time_s), None),
        (lambda t: t.rename(columns={"east_m": "north_m", "north_m": "east_m"}), "east and north exchanged?"),
        (lambda t: t.assign(east_m=t.east_m / 1000, north_m=t.north_m / 1000), "are they in km?"),
        (lambda t: t.assign(north_m=-t.north_m), "does north run downward?"),
        (lambda t: t.assign(east_m=t.east_m + 5e5), "in the same coordinates, in m"),
    ],
)
def test_tracks_elsewhere_are_asked_about(files, monkeypatch, capsys, change, asked):
    tracks, folder = files
    change(tracks).to_csv(folder / "tracks.csv", index=False)
    monkeypatch.setattr(
        "sys.argv", ["glintrack", "score", str(folder / "tracks.csv"), str(folder / "truth.csv")]
    )
    with pytest.raises(SystemExit) as end:
        app.main()
    said = capsys.readouterr().out
    assert end.value.code == 0
    assert (asked in said) if asked else ("hardly" not in said)


@pytest.mark.parametrize(
    ("change", "asked"),
    [
        (lambda t: t.rename(columns={"east_m": "north_m", "north_m": "east_m"}), "east and north exchanged?"),
        (lambda t: t.assign(north_m=-t.north_m), "does north run downward?"),
    ],
)
def test_in_a_window_that_holds_both_the_places_at_each_time_tell(
    tmp_path, monkeypatch, capsys, change, asked
):
    """As wide as high, about the origin."""
    rows = [(t, v, -90.0 + 9 * t, 10.0 + 30 * v) for t in range(20) for v in range(3)]
    corners = [(0, 7, -95.0, -95.0), (0, 8, 95.0, 95.0)]
    truth = pd.DataFrame([*rows, *corners], columns=["time_s", "vehicle_id", "east_m", "north_m"])
    truth.to_csv(tmp_path / "truth.csv", index=False)
    tracks = truth.iloc[:60].rename(columns={"vehicle_id": "track_id"})
    change(tracks).to_csv(tmp_path / "tracks.csv", index=False)
    monkeypatch.setattr(
        "sys.argv", ["glintrack", "score", *(str(tmp_path / f"{n}.csv") for n in ("tracks", "truth"))]
    )
    with pytest.raises(SystemExit):
        app.main()
    assert asked in capsys.readouterr().out


def test_where_the_truth_says_what_is_inside_a_runs_scores_come_back(tmp_path):
    """Two cars in the window, one far beyond it."""
    rows = [(t, v, e + 10.0 * t, 5.0 * v, v < 2) for t in range(10) for v, e in enumerate((0.0, 0.0, 900.0))]
    truth = pd.DataFrame(rows, columns=["time_s", "vehicle_id", "east_m", "north_m", "inside"])
    truth.assign(inside=truth["inside"].astype(int)).to_csv(tmp_path / "truth.csv", index=False)
    tracks = truth[truth["vehicle_id"] == 0].rename(columns={"vehicle_id": "track_id"})
    tracks.to_csv(tmp_path / "tracks.csv", index=False)
    found = score(tmp_path / "tracks.csv", tmp_path / "truth.csv")
    assert found["completeness"] == 0.5
    assert found["tracked_per_km2"] == pytest.approx(1 / (90e-3 * 5e-3))
    assert score(tmp_path / "tracks.csv", tmp_path / "truth.csv", (0, 0, 1000, 10))["completeness"] < 0.5
    in_a_row = truth.assign(north_m=0.0)
    in_a_row.to_csv(tmp_path / "truth.csv", index=False)  # True and False, and a box without height
    assert score(tmp_path / "tracks.csv", tmp_path / "truth.csv")["false_per_frame"] == 0.0
    truth.assign(inside=2).to_csv(tmp_path / "truth.csv", index=False)
    with pytest.raises(ValueError, match="`inside` must hold 0 or 1"):
        score(tmp_path / "tracks.csv", tmp_path / "truth.csv")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--json", "truth.csv"), "`json` must end in .json; got 'truth.csv'"),
        (("--moving-m-s", "nan"), "`--moving-m-s` must be greater than or equal to 0 m/s; got nan"),
    ],
)
def test_wrong_options_are_refused_and_overwrite_nothing(files, monkeypatch, capsys, options, said):
    tracks, folder = files
    monkeypatch.chdir(folder)
    tracks.to_csv("tracks.csv", index=False)
    before = (folder / "truth.csv").read_bytes()
    monkeypatch.setattr("sys.argv", ["glintrack", "score", "tracks.csv", "truth.csv", *options])
    with pytest.raises(SystemExit) as end:
        app.main()
    assert end.value.code == 2 and said in capsys.readouterr().err
    assert (folder / "truth.csv").read_bytes() == before


def test_an_area_without_vehicles_is_named(files, monkeypatch, capsys):
    tracks, folder = files
    tracks.to_csv(folder / "tracks.csv", index=False)
    names = (str(folder / f"{name}.csv") for name in ("tracks", "truth"))
    area = ("--area", "5000", "5000", "5010", "5010")
    monkeypatch.setattr("sys.argv", ["glintrack", "score", *names, *area])
    with pytest.raises(SystemExit):
        app.main()
    assert "no vehicle in the area given is as fast as" in " ".join(capsys.readouterr().out.split())


def test_exchanged_files_are_recognized_by_their_columns(files, monkeypatch, capsys):
    tracks, folder = files
    tracks.to_csv(folder / "tracks.csv", index=False)
    monkeypatch.setattr(
        "sys.argv", ["glintrack", "score", str(folder / "truth.csv"), str(folder / "tracks.csv")]
    )
    with pytest.raises(SystemExit) as end:
        app.main()
    assert end.value.code == 2
    assert "Are tracks and truth exchanged? The tracks come first" in capsys.readouterr().err


def test_decimal_commas_are_recognized(files):
    tracks, folder = files
    tracks.astype({"east_m": str}).replace({"east_m": "-150.0"}, "-150,0").to_csv(
        folder / "tracks.csv", index=False
    )
    with pytest.raises(ValueError, match=r"`east_m` must hold numbers; got '-150,0' .*Write -150\.0, with"):
        score(folder / "tracks.csv", folder / "truth.csv")


def test_motchallenge_text_is_scored_as_its_table(files, monkeypatch, capsys):
    tracks, folder = files
    boxes = [
        f"{t.time_s + 1},{t.track_id},{2 * (t.east_m + 200) - 3},{2 * (500 - t.north_m) - 3},8,8,1,-1,-1,-1"
        for t in tracks.itertuples()
    ]
    (folder / "tracks.txt").write_text("\n".join(boxes))
    words = ["score", str(folder / "tracks.txt"), str(folder / "truth.csv"), "--rate", "1"]
    monkeypatch.setattr("sys.argv", ["glintrack", *words, "--geotransform", "-200", "500", "0.5"])
    with pytest.raises(SystemExit) as end:
        app.main()
    said = capsys.readouterr().out
    assert end.value.code == 0 and "a share of 1 of the moving vehicles is tracked" in said
    assert "60 boxes" in said and "60 rows" in said and "frame 1 is 0 s; 1 frames a second" in said
    monkeypatch.setattr("sys.argv", ["glintrack", "score", *[str(folder / "truth.csv")] * 2, "--rate", "1"])
    with pytest.raises(SystemExit) as end:
        app.main()
    assert end.value.code == 2 and "`rate` and `geotransform` must be used with" in capsys.readouterr().err
