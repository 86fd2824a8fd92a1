"""`glintrack score` asks what is wrong where hardly a track is a vehicle's."""

import pandas as pd
import pytest

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
