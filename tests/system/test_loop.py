"""The whole loop on scenes small enough to know the answer."""

import numba as nb
import numpy as np
import pytest
import xarray as xr

from glintrack import simulate
from tests.conftest import put_three_cars
from tests.plain import plain_case


def case(**changes):
    perfect = {"read_noise_e": 0.0, "full_well_e": 1e9, "integration_time_ms": 50.0, "bits": 24}
    design = {
        "name": "three cars",
        "channels": ["pan"],
        "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 16, "rate_hz": 2.0},
        "sensor": {**perfect, "rows": 240, "columns": 320},
    }
    return plain_case({**design, **changes})


@pytest.fixture(scope="module")
def tree():
    """Result of the case as it is."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        put_three_cars(monkeypatch)
        return simulate(case())


def test_three_cars_and_a_perfect_sensor_are_tracked_completely_and_purely(tree):
    start_up = 6  # frames in which background and confirmation settle: 3 s
    np.testing.assert_array_equal(tree["pan"]["completeness"].values[start_up:], 1.0)
    assert tree["pan"].attrs["purity"] == 1.0
    assert tree["pan"].attrs["identity_switches"] == 0
    np.testing.assert_array_equal(tree["pan"]["false_tracks"].values, 0)
    assert tree["pan"].attrs["position_rms_m"] < 1.5  # one superpixel


def test_spectra_are_asked_for_and_served(tree):
    assert tree["pan"]["queries_served"].values[6:].min() >= 1
    assert (tree["pan"]["queries_served"] <= tree["pan"]["queries_asked"]).all()


def test_spectra_at_once_are_of_what_was_seen_and_darken_nothing(three_cars):
    """Each car has a served mirror on it where it is in the same frame, and pan has no hole."""
    watched = []
    design = case(track={"query": {"at": "detection", "policy": "entropy"}})
    tree = simulate(design, watched.append)
    assert tree["pan"]["queries_served"].values[6:].min() >= 3
    assert tree["pan"].attrs["purity"] == 1.0
    truth = tree["truth"].to_dataset()
    for epoch in watched[6:]:
        served = epoch.spectra.isel(query=epoch.spectra["track_id"].values >= 0)
        now = np.abs(truth["time_s"].values - epoch.time_s) < 1e-6
        east = truth["east_m"].values[now] - served["east_m"].values[:, None]
        north = truth["north_m"].values[now] - served["north_m"].values[:, None]
        half_a_car_m = 2.25
        assert np.hypot(east, north).min(axis=0).max() < half_a_car_m
        assert np.isfinite(served["radiance"].values).all()
        inside = np.isfinite(epoch.image["stokes_radiance"].values).all(axis=-1)
        assert np.isfinite(epoch.image["pan"].values[inside]).all()


def test_same_seed_same_result_and_another_seed_another_noise(three_cars):
    short = {"frames": 5, "off_nadir_deg": 0.0, "altitude_m": 3000.0}
    first, again = simulate(case(flight=short)), simulate(case(flight=short))
    for path in ("pan", "pan/tracks", "truth"):
        xr.testing.assert_identical(first[path].to_dataset(), again[path].to_dataset())


def test_trackers_share_the_light(three_cars):
    """Two designs at once score as each does alone."""
    design = case(flight={"frames": 8, "rate_hz": 2.0, "off_nadir_deg": 0.0, "altitude_m": 3000.0})
    other = design.track.replace({"query.policy": "none"})
    both = simulate(design, trackers={"asks": design.track, "silent": other})
    alone = simulate(design)["pan"]
    silent = simulate(design.model_copy(update={"track": other}))["pan"]
    for name, one in (("asks", alone), ("silent", silent)):
        xr.testing.assert_identical(both[f"{name}/tracks"].to_dataset(), one["tracks"].to_dataset())


def test_tracks_from_raw_elements_do_not_depend_on_demosaicking(three_cars):
    """Frames differ, detections and tracks do not."""
    flight = {"frames": 8, "rate_hz": 2.0, "off_nadir_deg": 0.0, "altitude_m": 3000.0}
    spectra = {"query": {"at": "detection", "policy": "entropy"}, "detect": {"detector": "mosaic"}}
    found, frames = {}, {}
    for method in ("ppid", "eari"):
        design = case(flight=flight, track=spectra, channels=["dolp", "all"])
        seen = []
        found[method] = simulate(design.replace({"sensor.demosaic": method}), seen.append)
        frames[method] = seen[-1].image["dolp"].values
    assert not np.array_equal(frames["ppid"], frames["eari"], equal_nan=True)
    for path in ("dolp/tracks", "all/tracks"):
        assert found["ppid"][path].sizes["row"] > 0
        xr.testing.assert_identical(found["ppid"][path].to_dataset(), found["eari"][path].to_dataset())


def test_telling_late_asks_the_same_and_keeps_what_was_told_at_once(three_cars):
    flight = {"frames": 12, "rate_hz": 2.0, "off_nadir_deg": 0.0, "altitude_m": 3000.0}
    told, seen = {}, {0.0: [], 1.5: []}
    for lag_s, epochs in seen.items():
        reporting = {"method": "existence", "lag_s": lag_s}
        spectra = {"policy": "entropy", "at": "detection"}
        design = case(
            flight=flight, track={"detect": {"detector": "mosaic"}, "reporting": reporting, "query": spectra}
        )
        told[lag_s] = simulate(design, epochs.append)["pan"]
    live, late = told[0.0], told[1.5]
    for name in ("queries_asked", "queries_served"):
        np.testing.assert_array_equal(live[name], late[name])
    for one, two in zip(*seen.values(), strict=True):
        assert one.tracks.identical(two.tracks)
    for name in ("completeness_visible", "custody", "false_per_km2"):
        assert late.attrs[f"{name}_at_once"] == live.attrs[name]
    assert late.attrs["completeness_visible"] > live.attrs["completeness_visible"]  # told before birth too
    assert late.sizes["time"] == 12 and "custody_at_once" not in live.attrs
    times = late["tracks"]["time_s"].values
    assert (np.diff(times) >= 0).all() and times[0] < live["tracks"]["time_s"].values[0]


def test_an_interrupt_keeps_the_frames_done(three_cars):
    def stop(epoch):
        if epoch.index == 3:
            raise KeyboardInterrupt

    tree = simulate(case(), stop)
    assert tree.attrs["interrupted"] == 1
    assert tree.attrs["frames_done"] == 3
    assert tree["pan"].sizes["time"] == 3


@pytest.mark.parametrize("detector", ["mosaic", "median-motion"])
def test_nothing_is_detected_before_the_end_of_learning_and_scores_begin_there(three_cars, detector):
    flight = {"frames": 7, "rate_hz": 5.0, "off_nadir_deg": 0.0, "altitude_m": 3000.0}
    track, found = {"detect": {"detector": detector}, "query": {"policy": "none"}}, []
    design = case(flight=flight, track=track)
    tree = simulate(design, lambda epoch: found.append(len(epoch.detections)))
    learnt = design.track.count_learning_frames(5.0)
    assert learnt == {"mosaic": 4, "median-motion": 3}[detector]
    assert sum(found[:learnt]) == 0 and sum(found[learnt:]) > 0
    assert tree["pan"].attrs["frames"] == 7 - learnt and tree["pan"].sizes["time"] == 7


def test_light_made_ahead_changes_nothing(three_cars):
    """By one thread each frame is made when it is wanted, by two while the frame before is tracked."""
    found, before = [], nb.get_num_threads()
    try:
        for threads in (1, before):
            nb.set_num_threads(threads)
            found.append(simulate(case(flight={"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 8})))
    finally:
        nb.set_num_threads(before)
    for path in ("pan/tracks", "truth"):
        xr.testing.assert_identical(*(tree[path].to_dataset() for tree in found))


def test_the_name_of_a_case_is_no_case():
    with pytest.raises(TypeError, match=r"`case` must be a Case; got 'quickstart'\. Read"):
        simulate("quickstart")
