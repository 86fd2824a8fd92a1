"""The detector of rectified frames alone: false rate, symmetry, a known step, causality, history."""

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage
from scipy.stats import norm

from glintrack import track
from glintrack.track.design import DetectDesign
from glintrack.track.detect import median_motion, registration
from glintrack.track.detect.footprint import footprints, local_quantile, window_means
from glintrack.track.detect.median_motion import FOOTPRINT_M, MedianMotionDetector, _clutter_scale, _strength
from glintrack.track.detect.sliding_median import median_and_spread, standardize_change
from glintrack.track.files import FRAMES_DESIGN, as_rows, is_lasting, track_frames
from tests.plain import plain_tracker
from tests.track.moving_blobs import image, paint_cars, texture

SIDE = 160
EXTENT = (0.0, 0.0, float(SIDE), float(SIDE))
INTERVAL_S = 0.8
CARS = ((20.0, 60.0, 12.0, 0.0, 0.34), (140.0, 100.0, -9.0, 0.0, 0.03), (70.0, 20.0, 0.0, 14.0, 0.4))


def where(k):
    """East and north of each car at a frame."""
    return np.array([(e + INTERVAL_S * k * u, n + INTERVAL_S * k * v) for e, n, u, v, _ in CARS])


def sequence(count=6, seed=0, cars=True, noise=0.004, shift=0.3):
    """8-bit frames of textured ground that jitter and drift in gain, with bright and dark cars."""
    rng = np.random.default_rng(seed)
    ground = texture((SIDE, SIDE), 1.0, rng)
    frames = []
    for k in range(count):
        boxes = [
            (e, n, np.arctan2(u, v), 4.5, 1.8, r)
            for (e, n), (_, _, u, v, r) in zip(where(k), CARS, strict=True)
        ]
        clean = paint_cars(ground, EXTENT, 1.0, boxes) if cars else ground
        frame = ndimage.shift(clean, rng.normal(0, shift, 2), order=3, mode="nearest")
        frame = (1 + 0.05 * np.sin(k)) * frame + rng.normal(0, noise, frame.shape)
        frames.append(np.clip(np.rint(frame / 0.5 * 255), 1, 255).astype(np.float32))
    return frames


def detect(frames):
    """Detections of each frame, with nothing tracked."""
    detector, state, out = MedianMotionDetector(DetectDesign(max_speed_m_s=36.0)), None, []
    for k, values in enumerate(frames):
        frame = track.Frame(INTERVAL_S * k, image(values, extent_of(values), 1.0))
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        nobody = track.Association(np.zeros(len(found), bool))
        state = detector.update(state, frame, found, nobody)
        out.append(found)
    return out


def extent_of(values):
    return (0.0, 0.0, float(values.shape[1]), float(values.shape[0]))


def follow(frames, **changes):
    design = FRAMES_DESIGN.replace(changes)
    images = ((INTERVAL_S * k, image(v, extent_of(v), 1.0)) for k, v in enumerate(frames))
    return list(track_frames(images, design))


def test_bright_and_dark_cars_are_found_from_the_third_frame():
    """Each car has a detection that would decide alone, with its velocity; and little else has."""
    found = detect(sequence())
    assert [len(found[k]) for k in (0, 1)] == [0, 0]
    for k in range(2, 6):
        sure = found[k].contrast >= 1
        places = found[k].position[sure]
        for at, (_, _, u, v, _) in zip(where(k), CARS, strict=True):
            distance = np.hypot(*(places - at).T)
            assert distance.min() < 1.5  # a pixel and a half
            speed = found[k].velocity[sure][distance.argmin()]
            assert np.hypot(*(speed - (u, v))) < 2.5  # two pixels a frame
        assert sure.sum() <= len(CARS) + 1


def test_a_static_scene_stays_within_the_stated_rate():
    """Jitter of 0.3 pixel, drifting gain, noise, 8 bits: at most two sure detections per km² a frame."""
    count = sum(
        int((one.contrast >= 1).sum())
        for seed in range(4)
        for one in detect(sequence(8, seed, cars=False))[2:]
    )
    km2 = 4 * 6 * (SIDE * 1e-3) ** 2
    assert count / km2 <= 2.0


def test_a_mirrored_scene_gives_mirrored_detections():
    frames = sequence()
    plain = detect(frames)[-1]
    sure = plain.contrast >= 1
    turns = {
        "east-west": (lambda f: f[:, ::-1], lambda p: np.stack([SIDE - p[:, 0], p[:, 1]], 1)),
        "north-south": (lambda f: f[::-1], lambda p: np.stack([p[:, 0], SIDE - p[:, 1]], 1)),
        "quarter turn": (lambda f: np.rot90(f), lambda p: np.stack([SIDE - p[:, 1], p[:, 0]], 1)),
    }
    for name, (of_frame, of_place) in turns.items():
        other = detect([np.ascontiguousarray(of_frame(f)) for f in frames])[-1]
        expected = of_place(plain.position[sure])
        distance = np.hypot(*(expected[:, None] - other.position[None]).transpose(2, 0, 1))
        a_fifth_of_a_pixel_m = 0.2  # every step but the search's order is symmetric
        assert (distance.min(axis=1) < a_fifth_of_a_pixel_m).all(), name


def test_nothing_leaks_from_later_frames():
    """What comes after a frame, in any order, changes nothing that was reported by then."""
    frames = sequence(8)
    whole = follow(frames)
    for cut, rest in ((4, (6, 5, 7, 4)), (6, (7, 6))):
        other = follow([*frames[:cut], *(frames[k] for k in rest)])
        assert len(by_then(whole, cut)) == len(by_then(other, cut)) >= cut
        for (_, mine), (_, theirs) in zip(by_then(whole, cut), by_then(other, cut), strict=True):
            assert mine.identical(theirs)


def by_then(reports, count):
    """What was given out with the first so many frames; each ends with its own report."""
    ends = [i for i, (_, tracks) in enumerate(reports) if not (tracks["status"] == "tentative").any()]
    return reports[: ends[count - 1] + 1]


def test_six_frames_have_tracks_from_the_first():
    """Once confirmed a track is reported back to the first frame, marked tentative; and not without that."""
    rows = as_rows(follow(sequence()))
    for k in range(6):
        here = np.isclose(rows["time_s"], INTERVAL_S * k)
        places = np.stack([rows["east_m"][here], rows["north_m"][here]], axis=-1)
        for at in where(k):
            assert np.hypot(*(places - at).T).min() < 3.0
        assert (rows["status"].values[here] == "tentative").all() == (k < 2)
    assert np.all(np.diff(rows["time_s"]) >= 0)
    live = as_rows(follow(sequence(), **{"reporting.history": False}))
    assert live["time_s"].values.min() >= 2 * INTERVAL_S - 1e-9
    assert "tentative" not in live["status"].values


def test_a_gap_is_filled_once_the_vehicle_is_measured_again():
    """Cars hidden in one frame: no place there until they are seen again, then that between neighbours."""
    frames, bare = sequence(8), sequence(8, cars=False)
    hidden = 5
    frames[hidden] = bare[hidden]
    until = as_rows(follow(frames[: hidden + 1]))
    assert not np.isclose(until["time_s"], INTERVAL_S * hidden).any()
    rows = as_rows(follow(frames))
    here = np.isclose(rows["time_s"], INTERVAL_S * hidden)
    places = np.stack([rows["east_m"][here], rows["north_m"][here]], axis=-1)
    assert len(places)
    for at in where(hidden):
        assert np.hypot(*(places - at).T).min() < 2.0


def test_known_step_in_known_noise_is_found_at_its_closed_form_rate():
    """Under one window the mean of n unit normals with a step s exceeds t with probability Φ((s − t) √n)."""
    rng = np.random.default_rng(3)
    rows, columns, weights = (part[:1] for part in footprints(4.6, 2.6, 1.0))
    effective = 1 / float((weights**2).sum())
    step, limit, trials = 1.0, 1.2, 4000
    side = 15
    hits = 0
    for _ in range(trials // 100):
        field = rng.normal(size=(side, side * 100)).astype(np.float32) + np.float32(step)
        means = window_means(field, (rows, columns, weights))
        hits += int((means[side // 2, side // 2 :: side] > limit).sum())
    expected = norm.cdf((step - limit) * np.sqrt(effective))
    four_sigma = 4 * np.sqrt(expected * (1 - expected) / trials)
    assert abs(hits / trials - expected) < four_sigma


def test_change_is_counted_in_its_own_standard_deviations():
    """White noise about a known background: the standardized change is a unit normal, whatever the gain."""
    rng = np.random.default_rng(4)
    background = texture((SIDE, SIDE), 1.0, rng)
    for sigma in (0.003, 0.03):
        seen = background + rng.normal(0, sigma, background.shape).astype(np.float32)
        nothing = np.zeros_like(background)
        z = standardize_change(seen, background, nothing, nothing, 1.0, 0.0)
        assert abs(np.std(z) - 1) < 0.03  # the quantile's own error over 25,600 pixels


def test_median_and_spread_are_numpys():
    rng = np.random.default_rng(5)
    stack = rng.normal(size=(7, 9, 11)).astype(np.float32)
    stack[rng.random(stack.shape) < 0.3] = np.nan
    median, spread = median_and_spread(stack)
    np.testing.assert_allclose(median, np.nanmedian(stack, axis=0), rtol=1e-6)
    distance = np.abs(stack - median)
    count = np.isfinite(stack).sum(axis=0)
    expected = np.sort(np.where(np.isfinite(distance), distance, np.inf), axis=0)
    expected = np.take_along_axis(expected, ((count - 1) // 2)[None], axis=0)[0]  # the lower of two middles
    np.testing.assert_allclose(spread, expected, rtol=1e-5, atol=1e-7)
    few, _ = median_and_spread(stack, least=7)
    np.testing.assert_array_equal(np.isfinite(few), count == 7)


def test_registration_finds_whole_and_local_shifts():
    """2.3 pixels of the whole and a third of a pixel more at one side, to a twentieth in the mean."""
    rng = np.random.default_rng(6)
    ground = ndimage.gaussian_filter(rng.normal(size=(SIDE, SIDE)), 1.5)
    rows, columns = np.mgrid[:SIDE, :SIDE].astype(float)
    extra = 0.33 * columns / SIDE
    seen = ndimage.map_coordinates(ground, [rows - 2.3 - extra, columns + 1.4], order=3, mode="nearest")
    shift = registration.estimate_shifts(seen.astype(np.float32), ground.astype(np.float32), 1.0)
    middle = (np.arange(shift.shape[1]) + 0.5) * SIDE / shift.shape[1]
    a_twentieth = 0.05
    assert np.abs(shift[..., 0] - 2.3 - 0.33 * middle / SIDE).mean() < a_twentieth
    assert np.abs(shift[..., 1] + 1.4).mean() < a_twentieth
    back = registration.shift_image(seen.astype(np.float32), shift)[8:-8, 8:-8]
    assert np.abs(back - ground[8:-8, 8:-8]).mean() < 0.1 * np.abs(seen - ground)[8:-8, 8:-8].mean()


@pytest.mark.parametrize("gain", [0.5, 1.0, 1.7])
def test_gain_is_found_beside_vehicles(gain):
    """One pixel in twenty is something else."""
    rng = np.random.default_rng(7)
    background = texture((SIDE, SIDE), 1.0, rng)
    seen = (background - 0.02) / gain
    other = rng.random(seen.shape) < 0.05
    seen[other] = 0.5
    found, offset = registration.gain_between(seen, background)
    assert abs(found / gain - 1) < 0.01 and abs(offset - 0.02) < 0.002


def test_moving_edges_of_no_data_are_no_vehicles():
    """Zeros beyond a border that wanders with the view, as mosaics have, are no data."""
    frames = sequence(8, cars=False)
    rows, columns = np.mgrid[:SIDE, :SIDE]
    for k, frame in enumerate(frames):
        frame[columns + 0.3 * rows < 40 + 5 * k] = 0
    assert sum(int((one.contrast >= 1).sum()) for one in detect(frames)[2:]) == 0


def test_frames_that_come_fast_are_not_all_remembered():
    """At 25 Hz the window still spans seconds, and a state is as small."""
    detector, state = MedianMotionDetector(DetectDesign()), None
    for k, values in enumerate(sequence(20)):
        frame = track.Frame(0.04 * k, image(values, EXTENT, 1.0))
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        state = detector.update(state, frame, found, track.Association(np.zeros(len(found), bool)))
    assert state is not None
    times = [one.times_s[0] for one in state.past]
    assert np.diff(times).min() >= median_motion.MEDIAN_SPACING_S - 1e-9


@pytest.mark.parametrize("shows", ["first", "last"])
def test_a_frame_written_twice_makes_no_ghosts(shows):
    """The recorder wrote one frame for two times, whichever it is of: cars are where they were."""
    frames = sequence(6)
    one = frames[1] if shows == "first" else frames[2]
    twice = [frames[0], one, one, *frames[3:]]
    found = detect(twice)
    assert len(found[2]) == 0  # the second copy: nothing new
    for k in (4, 5):
        sure = found[k].position[found[k].contrast >= 1]
        for at, (_, _, u, v, _) in zip(where(k), CARS, strict=True):
            distance = np.hypot(*(found[k].position - at).T)
            assert distance.min() < 1.5  # a pixel and a half
            speed = found[k].velocity[distance.argmin()]
            assert np.hypot(*(speed - (u, v))) < 2.5  # two pixels a frame
        assert len(sure) <= len(CARS) + 1


def test_places_told_late_are_those_of_then():
    """Of each car the detector says where it was in the three frames before."""
    found = detect(sequence(4))[3]
    assert found.earlier is not None and found.earlier.shape == (len(found), len(found.earlier_s), 2)
    assert found.earlier_s == pytest.approx([0.0, INTERVAL_S, 2 * INTERVAL_S])
    for k in (0, 1, 2):
        for at, now in zip(where(k), where(3), strict=True):
            mine = np.hypot(*(found.position - now).T).argmin()
            assert np.hypot(*(found.earlier[mine, k] - at)) < 1.5  # a pixel and a half


def test_frames_without_noise_are_no_numerical_fault():
    """A simulator's frames: all of the variance is the floor's, and a step counts in floors."""
    ground = np.ones((SIDE, SIDE), np.float32)
    image_now = ground.copy()
    image_now[80, 80] += 1.0
    slope2 = np.abs(np.random.default_rng(0).normal(size=ground.shape)).astype(np.float32)
    z = standardize_change(image_now, ground, np.zeros_like(ground), slope2, 1.0, 0.01)
    assert z[80, 80] == pytest.approx(1.0 / 0.01, rel=0.02)
    assert np.abs(z[:40]).max() == 0


def test_registration_ignores_what_is_missing():
    """Holes in frame and background: the shift of the rest is found to a twentieth of a pixel."""
    rng = np.random.default_rng(8)
    ground = ndimage.gaussian_filter(rng.normal(size=(SIDE, SIDE)), 1.5).astype(np.float32)
    seen = ndimage.shift(ground, (0.6, -0.4), order=3, mode="nearest")
    for one in (seen, ground):
        one[rng.random(one.shape) < 0.02] = np.nan
        one[:30, :40] = np.nan
    shift = registration.estimate_shifts(seen, ground, 1.0)
    assert np.abs(shift[..., 0] - 0.6).mean() < 0.05 and np.abs(shift[..., 1] + 0.4).mean() < 0.05


def test_a_sample_of_a_frame_comes_from_every_part_of_it():
    """At most as many as asked, and not from the same few columns."""
    frame = np.arange(12.0).reshape(3, 4)
    assert registration.subsample(frame, 12).tolist() == frame.ravel().tolist()
    for shape in ((100, 200), (101, 130), (64, 64), (90, 91)):
        rows, columns = np.indices(shape)
        taken = registration.subsample(rows * 1000 + columns, 500)
        assert 100 < len(taken) <= 500
        assert len(np.unique(taken % 1000)) > shape[1] // 4
        assert len(np.unique(taken // 1000)) > shape[0] // 2


def planes(count, contrast, dolp_contrast):
    """Two cars that differ from the ground in radiance, in DoLP, or in both: images, and where they are."""
    rng = np.random.default_rng(5)
    ground = texture((SIDE, SIDE), 1.0, rng)
    degree = np.full((SIDE, SIDE), 0.1, np.float32)
    for k in range(count):
        boxes = [(e, n, np.arctan2(u, v)) for (e, n), (*_, u, v, _) in zip(where(k), CARS, strict=True)]
        pan = paint_cars(ground, EXTENT, 1.0, [(*box, 4.5, 1.8, 0.15 + contrast) for box in boxes])
        pan = 40 * ((pan if contrast else ground) + rng.normal(0, 0.01, ground.shape))
        dolp = paint_cars(degree, EXTENT, 1.0, [(*box, 4.5, 1.8, 0.1 + dolp_contrast) for box in boxes])
        dolp = np.clip(dolp + rng.normal(0, 0.01, degree.shape), 0, 1)
        yield image(pan.astype(np.float32), EXTENT, 1.0, dolp.astype(np.float32))


def share_found(contrast, dolp_contrast, **keys):
    """Share of the cars that are found from the third frame on."""
    design = plain_tracker().replace({f"detect.{key}": value for key, value in keys.items()})
    state, found = track.start(design.replace({"detect.max_speed_m_s": 36.0})), []
    for k, one in enumerate(planes(6, contrast, dolp_contrast)):
        state, _ = track.step(state, track.Frame(INTERVAL_S * k, one))
        if k >= 2:
            place = state.detections.position[state.detections.contrast >= 1]
            apart = np.hypot(*(where(k)[:, None] - place[None]).transpose(2, 0, 1))
            found.append((apart.min(axis=1, initial=np.inf) <= 2.0).mean())
    return np.mean(found)


@pytest.mark.parametrize(
    ("contrast", "dolp_contrast", "sees"),
    [(0.35, 0.0, {"pan", "all"}), (0.0, 0.4, {"dolp", "all"})],
)
def test_channels_see_what_is_in_their_planes(contrast, dolp_contrast, sees):
    """Cars that show in one plane only: the other misses them, both together do not."""
    for name in ("pan", "dolp", "all"):
        assert (share_found(contrast, dolp_contrast, channel=name) >= 0.9) == (name in sees), name


def test_dolp_below_its_threshold_after_the_boost_is_all_alike():
    """Change from 0.1 to 0.2 is none below 0.35, unless boosted by 3; change to 0.5 is one."""
    keys = {"channel": "dolp", "dolp_threshold": 0.35}
    assert share_found(0.0, 0.1, **keys) < 0.2
    assert share_found(0.0, 0.4, **keys) >= 0.9
    assert share_found(0.0, 0.1, dolp_boost=3.0, **keys) >= 0.9


def test_nothing_is_found_where_the_frame_is_occluded():
    """A mask over half of the frame: vehicles under it are missed, and the others found."""
    state = track.start(plain_tracker().replace({"detect.max_speed_m_s": 36.0}))
    for k, one in enumerate(planes(6, 0.35, 0.0)):
        hidden = np.zeros(one["pan"].shape, np.int8)
        hidden[:, :90] = 1
        state, _ = track.step(
            state,
            track.Frame(INTERVAL_S * k, one.assign(occluded=(("y", "x"), hidden, {"units": "1"}))),
        )
    found = state.detections.position[state.detections.contrast >= 1]
    assert len(found) and (found[:, 0] > 90).all()


@pytest.mark.parametrize("gsd_m", [0.4, 1.0])
def test_noise_of_independent_pixels_is_not_scaled(gsd_m):
    """At the sizes of pixels of the model; noise that is constant in blocks is."""
    rng, windows = np.random.default_rng(5), footprints(*FOOTPRINT_M, gsd_m)
    assert _clutter_scale(rng.standard_normal((240, 240)), windows, gsd_m).max() <= 1.1
    blocks = np.kron(rng.standard_normal((40, 40)), np.ones((6, 6)))
    assert np.median(_clutter_scale(blocks, windows, gsd_m)) > 1.1


@pytest.mark.parametrize("gsd_m", [2.5, 4.0])
def test_noise_under_windows_of_few_pixels_is_no_stronger_than_under_those_of_many(gsd_m):
    """At 4 m noise alone became hundreds of tracks."""
    rng, strengths = np.random.default_rng(5), []
    for size_m in (1.0, gsd_m):
        noise, windows = rng.standard_normal((240, 240)), footprints(*FOOTPRINT_M, size_m)
        scaled = (noise / _clutter_scale(noise, windows, size_m)).astype(np.float32)
        strengths.append(np.quantile(_strength(scaled, windows), 0.75))
    assert strengths[1] < 1.15 * strengths[0]


def test_clutter_that_changes_pixels_together_makes_few_candidates():
    """Noise that is constant in blocks of 4 pixels in half the frame, of the same size in a pixel."""
    rng, frames = np.random.default_rng(5), []
    for values in sequence(6, 3, cars=False, shift=0.0):
        blocks = np.kron(rng.normal(0, 4.0, (SIDE // 4, SIDE // 8)), np.ones((4, 4)))
        frames.append(np.rint(values + np.hstack([blocks, rng.normal(0, 4.0, blocks.shape)])))
    found = detect(np.array(frames, np.float32))
    assert sum(map(len, found)) <= 10  # 59 without the local scale


def test_a_local_quantile_is_that_of_its_tile():
    """Ramps of two scales: the quantile of each tile, at its middle and beyond."""
    ramp = np.tile(np.linspace(0, 1, 60)[:, None], (1, 120))
    values = np.where(np.arange(120) < 60, ramp, 10 * ramp)
    local = local_quantile(values, np.ones(values.shape, bool), 0.75, 60)
    assert local[30, [0, 29, 90, 119]] == pytest.approx([0.75, 0.75, 7.5, 7.5], rel=0.05)  # of 400 samples
    assert local[30, 60] == pytest.approx(4.1, rel=0.05)


def test_tracks_that_end_early_are_left_out():
    """Tracks of 0.8 s, of 1.6 s, and one that the last frame still shows."""
    time_s, ident = np.array([0.0, 0.8, 0.0, 1.6, 3.2, 4.0]), np.array([1, 1, 2, 2, 3, 3])
    rows = xr.Dataset({"time_s": ("row", time_s), "track_id": ("row", ident)})
    assert set(rows["track_id"].values[is_lasting(rows, 4.0)].tolist()) == {2, 3}
    assert not len(is_lasting(xr.Dataset(), 4.0))


def test_earlier_positions_of_a_track_are_tentative():
    frames = ((0.5 * k, image(pan, EXTENT, 1.0)) for k, pan in enumerate(sequence(8)))
    rows = as_rows(track_frames(frames))
    assert set(np.unique(rows["tentative"].values)) == {0.0, 1.0}
