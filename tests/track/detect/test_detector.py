"""The detector's interface: any of three kinds can be passed in, and the tracker keeps its promises to it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from glintrack import track
from glintrack.core.records import Mosaic
from glintrack.track.design import DetectDesign
from glintrack.track.detect.detections import check, no_detections, of_boxes, order, take
from glintrack.track.detect.frame import in_view, plane
from tests.plain import plain_tracker
from tests.track.moving_blobs import image

EXTENT = (0.0, 0.0, 60.0, 60.0)
SPEED_M_S = 8.0
GRID = track.Grid((40, 40), (0.75, 59.25), 1.5)


def place(k):
    return np.array([[5.0 + 0.5 * SPEED_M_S * k, 20.0], [50.0, 5.0 + 0.5 * SPEED_M_S * k]])


@dataclass(frozen=True)
class BoxDetector:
    """Boxes, east-most first, of somebody who knows where the cars are; its state is what it was told."""

    def start(self, frame):
        return ()

    def detect(self, state, frame):
        half = np.array([2.2, 0.9])
        middle = place(round(frame.time_s / 0.5))
        box = np.concatenate([middle - half, middle + half], axis=1)
        return replace(of_boxes(box[np.argsort(-box[:, 0])], 0.5), detail=len(state))

    def update(self, state, frame, detections, association):
        assert detections.detail == len(state)  # handed back untouched
        assert np.all(np.diff(detections.position[:, 0]) <= 0)  # in the detector's own order
        return (*state, (detections, association))


def test_a_detector_of_boxes_needs_no_image():
    """Two cars by their boxes: two tracks, and the detector is told which boxes they explain."""
    state = track.start(detector=BoxDetector())
    for k in range(8):
        state, _ = track.step(state, track.Frame(0.5 * k, grid=GRID))
    tracks = track.report(state)
    assert tracks.sizes["track"] == 2
    np.testing.assert_allclose(np.sort(tracks["east_m"]), np.sort(place(7)[:, 0]), atol=0.5)
    _found, association = state.memory[-1]
    assert association.explained.all()
    assert not state.memory[0][1].explained.any()  # nothing is confirmed at first sight


def test_explained_detections_are_named_in_the_detectors_order():
    """One car has a track, the other appears later: only the first is explained, wherever it is listed."""

    class Late(BoxDetector):
        def detect(self, state, frame):
            found = super().detect(state, frame)
            return found if frame.time_s >= 3.5 else take(found, found.position[:, 1] == 20.0)

    state = track.start(detector=Late())
    for k in range(8):
        state, _ = track.step(state, track.Frame(0.5 * k, grid=GRID))
    found, association = state.memory[-1]
    np.testing.assert_array_equal(association.explained, found.position[:, 1] == 20.0)


@dataclass(frozen=True)
class MosaicDetector:
    """The brightest element of the raw mosaic, one metre to an element."""

    def start(self, frame):
        return None

    def detect(self, state, frame):
        z = (frame.mosaic.electrons - 1000.0) / frame.mosaic.sigma_e
        row, column = np.unravel_index(np.nanargmax(z), z.shape)
        found = of_boxes(np.array([[column - 1, row - 1, column + 1, row + 1]]), 0.5, z[row, [column]] / 5)
        return replace(found, log_likelihood_ratio=np.array([3.0]))

    def update(self, state, frame, detections, association):
        return state


def mosaic(k):
    electrons = np.full((60, 60), 1000.0)
    electrons[20, 5 + 4 * k] = 4000.0
    electrons[0, 0] = np.nan  # a mirror that was away
    return Mosaic(electrons, np.sqrt(np.nan_to_num(electrons, nan=1.0)), (("open",),), np.ones((1, 1, 3)))


def test_a_detector_of_the_raw_mosaic_sees_it_and_its_likelihood_counts():
    """The track stands on the bright element; a likelihood ratio of 3 nat raises its score by 3 a frame."""
    scores = {}
    for ratio in (0.0, 3.0):

        class Sure(MosaicDetector):
            def detect(self, state, frame, ratio=ratio):
                return replace(super().detect(state, frame), log_likelihood_ratio=np.array([ratio]))

        design = track.TrackDesign().replace({"reporting.max_false_share": 0.5})
        state = track.start(design, detector=Sure())
        for k in range(6):
            state, _ = track.step(state, track.Frame(0.5 * k, mosaic=mosaic(k), grid=GRID))
        np.testing.assert_allclose(track.report(state)["east_m"], [25.0], atol=0.5)
        scores[ratio] = state.targets.score[0]
    assert scores[3.0] - scores[0.0] == pytest.approx(5 * 3.0)  # the first detection only begins a track


def test_an_empty_frame_does_not_change_how_tracks_are_reported():
    """`no_detections` has no likelihood ratios, which say nothing where there is no detection."""

    class Sometimes(MosaicDetector):
        def detect(self, state, frame):
            return no_detections() if frame.time_s == 2.0 else super().detect(state, frame)

    state = track.start(track.TrackDesign(), detector=Sometimes())
    for k in range(6):
        state, _ = track.step(state, track.Frame(0.5 * k, mosaic=mosaic(k), grid=GRID))
        assert state.effective_design.reporting.uses_existence
    assert len(state.targets) == 1 and state.targets.confirmed.all()


def test_the_tracker_says_what_it_wants_searched():
    """Channel, interval and expected places come from the tracker."""
    seen = []

    class Keeping(BoxDetector):
        def detect(self, state, frame):
            seen.append(frame)
            return super().detect(state, frame)

    state = track.start(plain_tracker().replace({"detect.channel": "all"}), detector=Keeping())
    for k in range(6):
        state, _ = track.step(state, track.Frame(0.5 * k, grid=GRID))
    assert [f.interval_s for f in seen] == [0.0] + [0.5] * 5
    assert {f.channel for f in seen} == {"all"} and seen[0].planes == ("pan", "dolp")


def test_every_named_detector_is_made_and_named_in_the_design():
    names = DetectDesign.model_json_schema()["properties"]["detector"]["enum"]
    assert sorted(names) == sorted(["auto", *track.DETECTORS])
    for name, make in track.DETECTORS.items():
        detector = make(DetectDesign(detector=name))
        assert all(callable(getattr(detector, part)) for part in ("start", "detect", "update"))


def test_bad_detections_are_refused_in_one_sentence():
    class Bad(BoxDetector):
        def detect(self, state, frame):
            found = super().detect(state, frame)
            return replace(found, position=found.position * np.nan)

    state = track.start(detector=Bad())
    with pytest.raises(ValueError, match="`detections` must have finite positions"):
        track.step(state, track.Frame(0.0, grid=GRID))
    found = of_boxes(np.array([[0.0, 0.0, 2.0, 2.0]]), 1.0)
    with pytest.raises(ValueError, match=r"`detections.extent` must have shape \(1,\) for 1 positions"):
        check(replace(found, extent=np.ones(3)))
    with pytest.raises(ValueError, match="`frame` must have an image, or a grid without one; got neither"):
        track.step(state, track.Frame(0.0))
    with pytest.raises(ValueError, match="`frame` must have a rectified image for this detector"):
        track.step(track.start(), track.Frame(0.0, grid=GRID))


def test_boxes_stand_in_their_middle_and_are_taken_with_all_they_have():
    found = of_boxes(np.array([[4.0, 0.0, 8.0, 2.0], [0.0, 0.0, 2.0, 2.0]]), 0.5)
    np.testing.assert_array_equal(found.position, [[6, 1], [1, 1]])
    assert found.extent[1] == pytest.approx(np.sqrt(4 / np.pi * 4))
    west_first = take(replace(found, log_likelihood_ratio=np.array([1.0, 2.0])), order(found))
    assert west_first.position[0].tolist() == [1, 1] and west_first.log_likelihood_ratio.tolist() == [2, 1]
    assert len(no_detections()) == 0 and len(of_boxes(np.empty((0, 4)), 1.0)) == 0


def test_what_is_missing_or_occluded_is_out_of_view():
    pan = np.ones((40, 40), np.float32)
    pan[:, :10] = np.nan
    hidden = np.zeros((40, 40), np.int8)
    hidden[:, 30:] = 1
    frame = track.Frame(0.0, image(pan, EXTENT, 1.5).assign(occluded=(("y", "x"), hidden, {"units": "1"})))
    where = np.array([[5.0, 30.0], [30.0, 30.0], [55.0, 30.0], [200.0, 30.0]])
    assert in_view(frame, GRID, where).tolist() == [0, 1, 0, 0]
    assert np.isnan(plane(frame, "pan")[:, 30:]).all()
    assert in_view(track.Frame(0.0, grid=GRID), GRID, where).tolist() == [1, 1, 1, 1]


def test_what_is_no_detections_is_refused():
    class Listed(BoxDetector):
        def detect(self, state, frame):
            return []

    with pytest.raises(ValueError, match=r"`detect` of Listed must return track.Detections .* got list"):
        track.step(track.start(detector=Listed()), track.Frame(0.0, grid=GRID))


def test_unknown_detector_is_one_sentence():
    with pytest.raises(ValueError, match=r"`detect.detector` must be .*median-motion"):
        plain_tracker().replace({"detect.detector": "optical-flow"})
