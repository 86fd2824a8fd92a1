"""What is kept of a flight: film, served queries, paints, and which vehicle each track is on."""

import gc
import weakref

import numpy as np
import pytest

import glintrack
from glintrack import metrics, simulate
from glintrack.results.recorder import Recorder
from glintrack.results.write import write_result
from tests.system.test_loop import case

FLIGHT = {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 8}


@pytest.fixture
def flown(three_cars, tmp_path):
    design = case(flight=FLIGHT, output={"film_frames": 3, "keep_frames": 0})
    recorder = Recorder(design)
    tree = simulate(design, recorder.record)
    write_result(tmp_path, design, tree, recorder)
    return recorder, tree, tmp_path


def design_score(recorder):
    return recorder.case.track.initiation.confirm_score


@pytest.mark.slow
def test_a_flight_leaves_all_the_page_needs(flown):
    recorder, tree, folder = flown
    loaded = glintrack.load_result(folder)
    assert len(list((folder / "film").glob("*.webp"))) == 4 * 3
    assert recorder.film.index()["times_s"] == pytest.approx(
        [tree["pan"]["time"].values[k] for k in sorted(recorder.film.frames)]
    )
    for channel in recorder.case.channels:
        served = loaded[f"{channel}/queries"].to_dataset(inherit=False)
        assert served.sizes.get("row", 0) == tree[channel]["queries_served"].sum()
        assert np.isfinite(served["radiance"].values).all()
        if tree[channel].attrs["purity"] == tree[channel].attrs["purity"]:
            assert tree[channel]["purity"].values[-1] == pytest.approx(tree[channel].attrs["purity"])
    assert loaded["vehicles"]["vehicle"].values.tolist() == [11, 22, 33]
    rows = loaded["pan/tracks"].to_dataset(inherit=False)
    assert rows.sizes["row"] > 0
    cars = loaded["truth"].to_dataset(inherit=False)
    match_m = metrics.MATCH_DISTANCE_M
    for k in np.flatnonzero(rows["vehicle_id"].values >= 0):
        mine = (cars["vehicle_id"] == rows["vehicle_id"][k]) & (cars["time_s"] == rows["time_s"][k])
        place = [
            float(cars[name].values[mine.values][0] - rows[name].values[k]) for name in ("east_m", "north_m")
        ]
        assert np.hypot(*place) <= match_m
    found = loaded["pan/detections"].to_dataset(inherit=False)
    assert set(np.unique(found["time_s"].values)) <= set(tree["pan"]["time"].values)
    swept = loaded["pan/froc"].to_dataset(inherit=False)
    assert float(swept.sel(threshold=swept.attrs["own"])["completeness"]) > 0
    for name in ("sky", "light", "elements"):
        assert (folder / "pictures" / f"{name}.png").stat().st_size > 5000


def test_what_a_detector_alone_needs_of_a_frame_is_not_kept(three_cars):
    """It holds whole frames: kept for every frame, a long flight would fill the memory."""
    design = case(flight={**FLIGHT, "frames": 3}, sensor={"rows": 80, "columns": 120})
    recorder, seen = Recorder(design), []

    def watch(epoch):
        recorder.record(epoch)
        seen.append(weakref.ref(epoch.detections))

    simulate(design, watch)
    recorder.observer = None
    gc.collect()
    assert len(seen) == 3 and [one() for one in seen] == [None, None, None]


def test_beyond_what_eyes_see_there_is_no_natural_colour(three_cars, tmp_path):
    infrared = {"wavelengths_um": (0.8, 0.85, 0.9, 0.95, 1.0)}
    design = case(
        flight={**FLIGHT, "frames": 4},
        sensor={"rows": 80, "columns": 120, "band_um": (0.8, 1.0), "spectrometer_um": (0.8, 1.0)},
        atmosphere=infrared,
        output={"film_frames": 2, "keep_frames": 0},
    )
    recorder = Recorder(design)
    tree = simulate(design, recorder.record)
    write_result(tmp_path, design, tree, recorder)
    assert recorder.film.index()["kinds"] == ["pan", "dolp", "aop"]
    drawn = {path.stem for path in (tmp_path / "pictures").glob("*.png")}
    assert {"view_dolp", "pan"} <= drawn and not {"rgb", "view_rgb"} & drawn


def test_pictures_and_film_of_an_interrupted_flight_end_with_the_last_complete_frame(three_cars):
    """The interrupt comes in the second channel of the fourth frame."""
    design = case(
        flight=FLIGHT, channels=["pan", "dolp"], sensor={"rows": 80, "columns": 120},
        output={"film_frames": 2, "keep_frames": 0}, bound={"every": 0},
    )  # fmt: skip
    recorder = Recorder(design)

    def watch(epoch):
        if epoch.index == 3 and epoch.channel == "dolp":
            raise KeyboardInterrupt
        recorder.record(epoch)

    tree = simulate(design, watch)
    assert tree.attrs["frames_done"] == 3 and recorder.colour is None
    recorder.end_at(3)
    last_s = tree["pan"]["time"].values[-1]
    assert {name: image.attrs["time_s"] for name, image in recorder.shown.items()} == {
        "pan": last_s, "dolp": last_s
    }  # fmt: skip
    assert recorder.film.index()["frames"] == [0, 2] and recorder.colour is not None
    assert {channel: len(found) for channel, found in recorder.found.items()} == {"pan": 3, "dolp": 3}
