"""The whole tracker on frames rendered here: tracks, masks, bad input, and that nothing is mutated."""

import dataclasses

import numpy as np
import pytest
import xarray as xr

from glintrack import metrics, track
from glintrack.track.files import DETECTIONS_DESIGN
from tests.plain import plain_tracker
from tests.track.moving_blobs import STOKES_VARIABLE, grid, image, paint_cars, street_traffic, texture, truth

EXTENT = (-90.0, -60.0, 90.0, 60.0)
AREA = (-80.0, -50.0, 80.0, 50.0)
GSD = 1.5
CARS = ((-70.0, 30.0, 90.0, 9.0, 0.5), (60.0, -20.0, 270.0, 7.0, 0.04), (10.0, -50.0, 0.0, 6.0, 0.45))


def three_cars(times_s, gsd_m=GSD, noise=0.3, seed=0, jitter_m=0.0):
    """Three cars that cross a noisy textured ground; radiances of about 6 with noise of 2 % at first."""
    rng = np.random.default_rng(seed)
    shape = tuple(len(axis) for axis in grid(EXTENT, gsd_m))[::-1]
    ground = texture(shape, gsd_m, rng)
    for t in times_s:
        cars, rows = [], []
        shift = rng.normal(0, jitter_m, 2)
        for k, (east, north, heading, speed, reflectance) in enumerate(CARS):
            h = np.deg2rad(heading)
            e, n = east + speed * t * np.sin(h), north + speed * t * np.cos(h)
            cars.append((e + shift[0], n + shift[1], h, 4.5, 1.8, reflectance))
            rows.append((k, e, n, h, speed))
        pan = 40 * paint_cars(ground, EXTENT, gsd_m, cars)
        pan = (pan + rng.normal(0, noise, pan.shape)).astype(np.float32)
        yield float(t), pan, truth(*(np.array(c) for c in zip(*rows, strict=True)))


def follow(frames, design=None, gsd_m=GSD, dolp=False, spectra=None, column_of=None):
    state = track.start(plain_tracker() if design is None else design)
    states, scores = [], []
    for t, pan, vehicles in frames:
        frame = track.Frame(t, image(pan, EXTENT, gsd_m, dolp=pan / 40 if dolp else None))
        state, _ = track.step(state, frame, spectra, column_of)
        states.append(state)
        scores.append(metrics.score_epoch(track.report(state), vehicles, AREA))
    return states, scores


@pytest.mark.parametrize(
    ("interval_s", "gsd_m", "dolp"),
    [(0.5, 1.5, False), (0.5, 0.75, False), (0.1, 1.5, False), (0.5, 1.5, True)],
)
def test_three_cars_are_tracked_completely_and_purely(interval_s, gsd_m, dolp):
    """Once the slowest has moved the 8 m that confirm a track, every epoch is complete and pure.

    The detector needs three frames, 0.35 s apart at least.
    """
    design = plain_tracker().replace({"detect.channel": "dolp" if dolp else "pan"})
    frames = three_cars(np.arange(0, 10, interval_s), gsd_m)
    _, scores = follow(frames, design, gsd_m, dolp)
    settled = scores[int(3.5 / interval_s) :]
    assert np.nanmin(metrics.completeness(settled)) == 1.0
    assert metrics.purity(scores) == 1.0
    assert metrics.summarize(settled)["false_per_frame"] == 0
    half_a_superpixel_m = 0.75
    assert metrics.summarize(settled)["position_rms_m"] < half_a_superpixel_m


def test_jitter_of_the_pose_makes_no_false_tracks():
    _, scores = follow(three_cars(np.arange(0, 10, 0.5), jitter_m=0.45))
    assert metrics.summarize(scores)["false_per_frame"] == 0
    assert np.nanmin(metrics.completeness(scores[7:])) == 1.0


def test_cars_of_the_first_frame_leave_no_lasting_ghosts():
    states, _ = follow(three_cars(np.arange(0, 5, 0.5)))
    last = states[-1].detections.position
    for east, north, *_ in CARS:
        assert np.hypot(*(last - [east, north]).T).min() > 5.0


def waits(hits, again_s=None):
    """How long a track is reported after its last hit, and after one false blob `again_s` later. [s]"""
    state, area, dt = track.start(DETECTIONS_DESIGN), track.Grid((40, 40), (-300.0, 300.0), 15.0), 0.5
    last = hits * dt
    for k in range(200):
        t = k * dt
        # brakes to a stand in the last two observations
        east = np.minimum(6.0 * t, 6.0 * (last - 1.0) + 2.0 * max(t - (last - 1.0), 0.0))
        there = k < hits or (again_s is not None and t == last + again_s)
        found = track.Detections(
            np.array([[min(east, 6.0 * (last - 1.0) + 1.0), 0.0]])[: int(there)],
            0.25 * np.eye(2)[None][: int(there)], np.full(int(there), 4.0), np.ones(int(there)),
        )  # fmt: skip
        state = track.step_detections(state, found, t, area)
        if there:
            seen = t
        elif not state.targets.confirmed.any():
            return t - seen
    return np.inf


def test_a_track_waits_as_long_as_it_was_followed():
    """Full quality after 3 s; a false blob near the end of the wait earns a sixth, no second full wait."""
    full, half = waits(20), waits(5)
    assert 10 < full <= 30.5
    assert half < 0.85 * full
    assert waits(20, again_s=full - 2.0) <= 0.5 * full


def test_missing_pixels_do_not_reach_the_state():
    """Dark mirrors, an empty corner, one frame of nodata and one with infinities."""
    rng = np.random.default_rng(1)
    frames = []
    for t, pan, vehicles in three_cars(np.arange(0, 10, 0.5)):
        pan = pan.copy()
        pan[rng.random(pan.shape) < 0.01] = np.nan
        pan[:20, :15] = np.nan
        if t == 5.0:
            pan[:] = np.nan
        if t == 6.0:
            pan[40, 40] = np.inf
        frames.append((t, pan, vehicles))
    states, scores = follow(frames)
    for state in states:
        for field in dataclasses.fields(state.targets):
            assert np.isfinite(getattr(state.targets, field.name)).all(), field.name
        found = state.detections.position
        assert np.isfinite(found).all() and not ((found[:, 0] < -70) & (found[:, 1] > 33)).any()
    assert metrics.summarize(scores[7:])["completeness"] == 1.0


def test_frames_of_nothing_are_fine():
    pan = np.full((80, 120), np.nan, np.float32)
    states, _ = follow([(0.5 * k, pan, truth(*(np.empty(0),) * 5)) for k in range(4)])
    assert track.report(states[-1]).sizes["track"] == 0
    flat = np.zeros((80, 120), np.float32)
    states, _ = follow([(0.5 * k, flat, truth(*(np.empty(0),) * 5)) for k in range(4)])
    assert track.report(states[-1]).sizes["track"] == 0


def test_same_frames_same_tracks():
    times = np.arange(0, 5, 0.5)
    (first, _), (second, _) = follow(three_cars(times)), follow(three_cars(times))
    xr.testing.assert_identical(track.report(first[-1]), track.report(second[-1]))


def test_step_changes_nothing_it_was_given():
    frames = list(three_cars(np.arange(0, 3, 0.5)))
    states, _ = follow(frames)
    before = states[-2]
    kept = {f.name: getattr(before.targets, f.name).copy() for f in dataclasses.fields(before.targets)}
    planes = [past.planes["pan"].copy() for past in before.memory.past]
    frame = image(frames[-1][1], EXTENT, GSD)
    copy = frame.copy(deep=True)
    again, _ = track.step(before, track.Frame(frames[-1][0], frame))
    for name, values in kept.items():
        np.testing.assert_array_equal(getattr(before.targets, name), values)
    for past, plane in zip(before.memory.past, planes, strict=True):
        np.testing.assert_array_equal(past.planes["pan"], plane)
    xr.testing.assert_identical(frame, copy)
    xr.testing.assert_identical(track.report(again), track.report(states[-1]))


def test_turned_frames_give_turned_tracks():
    """The frames turned by 180° meet the raster in reverse order: the same tracks, turned."""
    frames = list(three_cars(np.arange(0, 6, 0.5)))
    straight, _ = follow(frames)
    turned, _ = follow([(t, np.ascontiguousarray(pan[::-1, ::-1]), v) for t, pan, v in frames])
    a, b = track.report(straight[-1]), track.report(turned[-1])
    east, back = np.sort(a["east_m"].values), np.sort(-b["east_m"].values)
    tenth_of_a_superpixel_m = 0.15  # the registration reads every other row
    np.testing.assert_allclose(east, back, atol=tenth_of_a_superpixel_m)


def test_queries_are_for_the_next_frame():
    """Cars at constant speed: each query lies where its car will be, one per column."""
    frames = list(three_cars(np.arange(0, 5, 0.5)))
    columns = lambda enu: np.floor((enu[:, 0] + 90) / GSD).astype(int)  # noqa: E731
    for policy, expected in (("entropy", 3), ("random", 3), ("none", 0)):
        state, queries = track.start(plain_tracker().replace({"query.policy": policy}), seed=4), ()
        for t, pan, _ in frames[:-1]:
            state, queries = track.step(state, track.Frame(t, image(pan, EXTENT, GSD)), None, columns)
        queries = [q for q in queries if q.track_id >= 0]  # the others ask what the ground observations like
        assert len(queries) == expected
        vehicles = frames[-1][2]
        for q in queries:
            miss = np.hypot(vehicles["east_m"].values - q.east_m, vehicles["north_m"].values - q.north_m)
            assert miss.min() < 1.5  # a superpixel [m]
            assert q.track_id in track.report(state)["track"].values


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", [0.5, 0.1])
def test_dense_traffic(interval_s):
    """60 cars that queue at lights, jitter of 0.3 superpixel, contrasts down to none."""
    rng = np.random.default_rng(3)
    times = np.arange(0, 20, interval_s)
    extent = (-165.0, -105.0, 165.0, 105.0)
    ground = texture((140, 220), 1.5, rng)
    paint, state, scores = {}, track.start(plain_tracker()), []
    for t, row in zip(times, street_traffic(times, 60, rng, extent), strict=True):
        ids, east, north, heading, _ = row
        for i in ids:
            paint.setdefault(i, rng.choice([0.04, 0.08, 0.35, 0.5]))
        dx, dy = rng.normal(0, 0.45, 2)
        cars = [
            (e + dx, n + dy, h, 4.5, 1.8, paint[i])
            for i, e, n, h in zip(ids, east, north, heading, strict=True)
        ]
        pan = 40 * paint_cars(ground, extent, 1.5, cars)
        pan = (pan * (1 + rng.normal(0, 1 / 60, pan.shape))).astype(np.float32)
        state, _ = track.step(state, track.Frame(float(t), image(pan, extent, 1.5)))
        if t >= 5:
            scores.append(metrics.score_epoch(track.report(state), truth(*row), extent))
    summary = metrics.summarize(scores)
    # what the design was measured to reach on other seeds, less its spread
    assert summary["completeness"] > 0.85 and summary["purity"] > 0.97
    assert summary["false_per_frame"] < 2


def test_bad_frames_are_refused_in_one_sentence():
    good = image(np.ones((80, 120), np.float32), EXTENT, GSD)
    state, _ = track.step(track.start(), track.Frame(1.0, good))
    with pytest.raises(ValueError, match="`time_s` must be later than the last frame's 1 s; got 1"):
        track.step(state, track.Frame(1.0, good))
    with pytest.raises(ValueError, match="`time_s` must be later"):
        track.step(state, track.Frame(float("nan"), good))
    with pytest.raises(ValueError, match=r"`image` must keep its size \(80, 120\); got \(79, 120\)"):
        track.step(state, track.Frame(2.0, good.isel(y=slice(1, None))))
    moved = good.assign_coords(x=("x", good["x"].values + 3, {"units": "m"}))
    with pytest.raises(ValueError, match="`image` must keep its grid"):
        track.step(state, track.Frame(2.0, moved))
    far = good.assign_coords(y=("y", good["y"].values + 5.8e6, {"units": "m"}))
    state, _ = track.step(track.start(), track.Frame(1.0, far))
    moved = far.assign_coords(y=("y", far["y"].values + 40, {"units": "m"}))
    with pytest.raises(ValueError, match="`image` must keep its grid"):
        track.step(state, track.Frame(2.0, moved))
    with pytest.raises(ValueError, match="`image` must be a square grid, x rising and y falling"):
        track.step(state, track.Frame(2.0, good.isel(y=slice(None, None, -1))))
    with pytest.raises(ValueError, match=r"`image.dolp` must be present"):
        track.step(state, track.Frame(2.0, good.drop_vars("dolp")))
    turned = good.copy()
    turned[STOKES_VARIABLE].attrs["stokes_frame"] = "detector"
    with pytest.raises(ValueError, match="must be in the meridian frame; got 'detector'"):
        track.step(state, track.Frame(2.0, turned))
    with pytest.raises(ValueError, match="`image` must be a Dataset with coordinates y and x"):
        track.step(state, track.Frame(2.0, good.drop_vars(["x", "y"])))


def test_bad_designs_are_refused():
    with pytest.raises(ValueError, match=r"`detect.channel` must be"):
        plain_tracker().replace({"detect.channel": "colour"})
    with pytest.raises(ValueError, match="Did you mean `dolp_threshold`"):
        plain_tracker().replace({"detect.dolp_treshold": 0.3})
    with pytest.raises(ValueError, match=r"`initiation.confirm_score` must be"):
        plain_tracker().replace({"initiation.confirm_score": float("nan")})


def spread_after(rate_hz, correlation_s):
    """Standard deviation of a position after 4 s [m], and number of tracks after a jump of 2.5 m."""
    state, area = track.start(plain_tracker()), track.Grid((40, 40), (-300.0, 300.0), 15.0)
    count = round(4 * rate_hz)
    for k in range(count):
        jump_m = 2.5 * (k == count - 1)
        found = track.Detections(
            np.array([[8.0 * k / rate_hz + jump_m, 0.0]]), 0.25 * np.eye(2)[None], np.ones(1), np.ones(1),
            correlation_s=correlation_s,
        )  # fmt: skip
        state = track.step_detections(state, found, k / rate_hz, area)
    return float(np.sqrt(state.targets.covariance[0, 0, 0])), len(state.targets)


def test_correlated_errors_do_not_average_out_at_a_high_frame_rate():
    """A vehicle that shows its other end is another one to a tracker that trusts its average."""
    assert spread_after(30.0, 0.0) == (pytest.approx(0.15, abs=0.1), 2)
    slow, (fast, tracks) = spread_after(2.0, 0.5)[0], spread_after(30.0, 0.5)
    assert tracks == 1
    assert fast == pytest.approx(slow, rel=0.5)
