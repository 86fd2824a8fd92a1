"""Fit the logistic models of detector and tracker, and write them to ``data/calibration``.

``python tools/calibrate.py mosaic`` simulates several kinds of traffic, angles, rates and pitches
(`MOSAIC_FLIGHTS`), so that one model holds for all of them. It runs the detector over each in each channel,
over the sensor without polarizers too in `pan`, and labels the peaks by the truth: one peak of a visible
moving vehicle is a vehicle, what is far from every vehicle is clutter, the rest says nothing. A model of
`mosaic_peaks.FEATURES` is fitted; every flight and, within it, vehicles and clutter weigh the same, which
takes out the flights' own odds. Residuals of the likely peaks give height and standard deviations. Masks and
places are those of the present model: run it twice after a change of the detector.

``python tools/calibrate.py existence`` simulates two cities and four other kinds of traffic
(`EXISTENCE_FLIGHTS`), tracks them in each channel with the tracker of the packaged case, takes all that is
confirmed, and labels every track at every frame by the truth, as the scores do: right or false. A track
near a standing vehicle says nothing. A model of `existence.existence_features` is fitted to each channel,
every flight weighing the same; then one of the features of `reporting.report_candidates`, 1.5 s later.

Both fits are maximum likelihood with a weak ridge.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.optimize import linear_sum_assignment, minimize
from scipy.special import expit

sys.path.insert(0, str(Path(__file__).parents[1]))
from glintrack import metrics, track
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.io.toml import to_toml
from glintrack.track import existence, reporting
from glintrack.track.calibration import Calibration, LogisticModel, calibration_file, read_calibration
from glintrack.track.design import DetectDesign
from glintrack.track.detect.detections import Association
from glintrack.track.detect.frame import grid_of
from glintrack.track.detect.mosaic import MosaicDetector, SearchedMosaic
from glintrack.track.detect.mosaic_peaks import FEATURES, MIN_RATIO
from glintrack.track.initiation import select
from tools.record_flight import Recording, record_flight

CHANNELS = ("pan", "dolp", "all")
RIDGE = 1e-3


def write_calibration(name: str, calibration: Calibration, digits: int = 2) -> None:
    """Write a calibration with rounded weights, and forget the one read before."""
    models = {}
    for key, model in calibration.models.items():
        weights = [round(float(weight), digits) for weight in model.weights]
        own = dict(zip(model.features, weights, strict=True))
        models[key] = {"intercept": round(float(model.intercept), digits), "weights": own}
    values = {"source": calibration.source, "valid": dict(calibration.valid), "models": models}
    if calibration.constants:
        values["constants"] = dict(calibration.constants)
    calibration_file(name).write_text(to_toml(values), encoding="utf-8")
    read_calibration.cache_clear()


def fit_logistic(features: np.ndarray, label: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Intercept and weights of the log odds that a label is 1, with a weight for each item."""
    scale = np.maximum(features.std(axis=0), 1e-9)
    x = np.column_stack([np.ones(len(label)), features / scale])

    def loss(w):
        z = x @ w
        value = weight @ (np.logaddexp(0, z) - label * z) + RIDGE * np.mean(w[1:] ** 2)
        return value, x.T @ (weight * (expit(z) - label)) + 2 * RIDGE * np.r_[0, w[1:]] / (len(w) - 1)

    w = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return np.r_[w[0], w[1:] / scale]


# ---- detector `mosaic`

_NADIR = ("flight.off_nadir_deg=8.0", "flight.altitude_m=2970.0")
_VARIED = ("scene.material_variation=1", "flight.frames=24", "sensor.rows=280", "sensor.columns=440")
_60_DEG = ("flight.off_nadir_deg=60.0", "flight.altitude_m=1500.0", "flight.azimuth_from_sun_deg=150")
MOSAIC_FLIGHTS = (
    ("quickstart:11", ()), ("braunschweig:11", ()), ("suburb:1", ()), ("arterial:1", ()), ("motorway:1", ()),
    ("junction:1", ()), ("arterial:1", _NADIR),
    ("quickstart:13", (*_VARIED, "flight.azimuth_from_sun_deg=0")),
    ("arterial:3", (*_VARIED, "flight.off_nadir_deg=25.0", "flight.altitude_m=2719.0")),
    ("quickstart:14", (*_VARIED, "flight.frames=56", "flight.rate_hz=10", "sensor.max_frame_rate_hz=10")),
    ("embedded:23", (*_VARIED, "sensor.pitch_um=10.0", "flight.azimuth_from_sun_deg=180")),
    ("suburb:3", (*_VARIED, *_60_DEG)),
)  # fmt: skip
SETTLED_S = 4.0  # before it the ground is still being learnt
LIKELY = 3.0  # nat from which a peak's place counts among the residuals
# where the fit holds
VALID = {
    "detector": "mosaic", "gsd_m": [0.44, 0.75], "rate_hz": [2.0, 10.0], "off_nadir_deg": [8.0, 50.0],
    "max_speed_m_s": [22.0], "flights": [" ".join((name, *keys)) for name, keys in MOSAIC_FLIGHTS],
}  # fmt: skip


@dataclass(frozen=True)
class Peaks:
    """Peaks of some flights: features, 1 for vehicles and 0 for clutter, and residuals of the vehicles.

    Residuals are those of the place seen: away from the camera, over the tangent of the off-nadir angle,
    which is a height; and across. [m]
    """

    features: np.ndarray
    vehicle: np.ndarray
    residual_m: np.ndarray


def label_flight(recording: Recording, sensor: str, channel: str) -> Peaks:
    """Collect the peaks of a simulation in a channel, after background learning."""
    detector, state, times_s, parts = MosaicDetector(DetectDesign()), None, [], []
    for frame, truth in zip(recording.sensor_frames(sensor), recording.truths, strict=True):
        frame = frame_for(frame, channel, frame.time_s - times_s[-1] if times_s else 0.0)
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        times_s.append(frame.time_s)
        if frame.time_s - times_s[0] >= SETTLED_S:
            parts.append(label_peaks(found.detail, frame.pose, truth, recording.extent_m))
        nobody = Association(np.zeros(len(found), bool), np.empty((0, 2)))
        state = detector.update(state, frame, found, nobody)
    return concatenate_peaks(parts)


def frame_for(frame, channel: str, interval_s: float):
    """Make a frame as the tracker gives it to a detector."""
    return replace(frame, grid=grid_of(frame, None), channel=channel, interval_s=interval_s)


def concatenate_peaks(parts: list[Peaks]) -> Peaks:
    """All of them."""
    columns = zip(*((p.features, p.vehicle, p.residual_m) for p in parts), strict=True)
    return Peaks(*(np.concatenate(column) for column in columns))


def label_peaks(seen: SearchedMosaic, pose, truth, extent_m) -> Peaks:
    """Label the peaks of a frame by the truth."""
    if len(seen.peaks) == 0:
        return Peaks(seen.peaks.features, np.empty(0), np.empty((0, 2)))
    vehicle_m = np.stack([truth["east_m"].values, truth["north_m"].values], axis=-1)
    wanted = np.asarray(
        metrics.is_in_area(truth, extent_m) & metrics.is_moving(truth) & metrics.is_visible(truth)
    )
    reach_m = np.maximum(4.0, truth["length_m"].values / 2 + 1)
    off_m = pose.position[:2] - seen.place_m
    slope = np.hypot(*off_m.T) / pose.up_m
    toward = off_m / np.hypot(*off_m.T)[:, None]
    height_m = read_calibration("mosaic").constants["place"]["all"]["height_m"]
    standing_m = seen.place_m + (height_m * slope)[:, None] * toward
    distance_m = np.hypot(*(standing_m[:, None] - vehicle_m).transpose(2, 0, 1))
    near = distance_m <= reach_m
    candidate = np.flatnonzero(near.any(axis=1))
    # each vehicle has one peak, the nearest or one that is much stronger
    cost = np.where(
        near[candidate], distance_m[candidate] - 3 * np.minimum(seen.ratio, 1)[candidate, None], 1e3
    )
    row, column = linear_sum_assignment(cost)
    own = near[candidate[row], column] & wanted[column]
    peak, of = candidate[row[own]], column[own]
    clutter = np.flatnonzero((distance_m > np.maximum(5.0, reach_m)).all(axis=1))
    gap_m = seen.place_m[peak] - vehicle_m[of]
    away = -toward[peak]
    residual = np.stack(
        [(gap_m * away).sum(axis=1) / slope[peak], gap_m[:, 0] * away[:, 1] - gap_m[:, 1] * away[:, 0]],
        axis=-1,
    )
    index = np.r_[peak, clutter]
    label = np.r_[np.ones(len(peak)), np.zeros(len(clutter))]
    return Peaks(seen.peaks.features[index], label, residual)


def fit_peaks(sets: list[Peaks]) -> np.ndarray:
    """Intercept and weights of the log likelihood ratio, from flights that weigh the same."""
    data = concatenate_peaks(sets)
    weight = np.concatenate(
        [np.where(one.vehicle > 0, 0.5 / one.vehicle.sum(), 0.5 / (1 - one.vehicle).sum()) for one in sets]
    ) / len(sets)
    return fit_logistic(data.features, data.vehicle, weight)


def detection_ratio(sets: list[Peaks], law: np.ndarray) -> float:
    """Log ratio of the shares of vehicles and of clutter that are detected, mean over flights."""
    ratios = []
    for data in sets:
        strong = law[0] + data.features @ law[1:] > MIN_RATIO
        vehicle = data.vehicle > 0
        ratios.append(np.log(np.mean(strong[vehicle]) / max(np.mean(strong[~vehicle]), 1e-6)))
    return float(np.mean(ratios))


def residuals(data: Peaks, law: np.ndarray) -> dict[str, float]:
    """Height of what is seen, and standard deviations, from quantiles: some peaks are of another vehicle."""
    ratio = law[0] + data.features[data.vehicle > 0] @ law[1:]
    height, across = data.residual_m[ratio > LIKELY].T
    share = 2 * 0.674489750196082  # of a Gaussian between its quartiles
    spread = [np.subtract(*np.quantile(r, [0.75, 0.25])) / share for r in (height, across)]
    # along the line of sight the error of the peak itself adds to that of the height
    found = {"height_m": np.median(height), "height_sigma_m": spread[0], "sigma_m": spread[1]}
    return {name: round(float(value), 2) for name, value in found.items()}


def calibrate_mosaic() -> None:
    """Fit the models of peaks, and write ``mosaic.toml``."""
    data: dict[str, list[Peaks]] = {channel: [] for channel in CHANNELS}
    for flight, changes in MOSAIC_FLIGHTS:
        recording = record_flight(flight, changes)
        for channel in CHANNELS:
            data[channel].append(label_flight(recording, "own", channel))
        data["pan"].append(label_flight(recording, "pan", "pan"))
    laws = {channel: fit_peaks(sets) for channel, sets in data.items()}
    shares = {channel: detection_ratio(sets, laws[channel]) for channel, sets in data.items()}
    places = {channel: residuals(concatenate_peaks(sets), laws[channel]) for channel, sets in data.items()}
    for channel, law in laws.items():
        vehicle = concatenate_peaks(data[channel]).vehicle
        counts = f"{int(vehicle.sum())} vehicles, {int((1 - vehicle).sum())} of clutter"
        print(f"{channel}: {np.round(law, 2)}, {counts}")
    print(shares, places)
    models = {channel: LogisticModel(FEATURES[channel], law[0], law[1:]) for channel, law in laws.items()}
    ratios = {channel: round(share, 2) for channel, share in shares.items()}
    constants = {"place": places, "detection_ratio": ratios}
    write_calibration("mosaic", Calibration("tools/calibrate.py mosaic", VALID, models, constants))


# ---- existence models of the tracker

EXISTENCE_FLIGHTS = (
    ("quickstart:11", ()), ("braunschweig:11", ()), ("suburb:1", ()), ("motorway:1", ()), ("arterial:1", ()),
    ("junction:1", ()), ("arterial:1", _NADIR), ("motorway:1", _NADIR),
)  # fmt: skip
EXISTENCE_VALID = {
    "detector": "mosaic", "gsd_m": [0.75], "rate_hz": [2.0], "off_nadir_deg": [8.0, 50.0],
    "speed_m_s": [0.0, 33.0], "flights": [" ".join((name, *keys)) for name, keys in EXISTENCE_FLIGHTS],
}  # fmt: skip
SETTLED_FRAMES = 4  # before it next to nothing is confirmed
LAG_S = 1.5

LabelledTracks = tuple[np.ndarray, np.ndarray]  # features, and 1 for right and 0 for false tracks


@dataclass(frozen=True)
class Flight:
    """Detections of a packaged case in a channel: time, detections, grid and truth of each frame."""

    case: str
    seed: int
    channel: str
    extent_m: tuple[float, float, float, float]
    found: list[tuple[float, track.Detections, track.Grid, xr.Dataset]]

    def states(self, keys: Mapping[str, object] | None = None) -> Iterator[track.TrackerState]:
        """Yield the tracker after each frame, with some keys changed."""
        state = track.start(design_of(self.case, self.channel, keys or {}), self.seed)
        for time_s, one, grid, _ in self.found:
            state = track.step_detections(state, one, time_s, grid)
            yield state


def design_of(case: str, channel: str, keys: Mapping[str, object]) -> track.TrackDesign:
    """Make the packaged case's tracker of a channel, with some keys changed."""
    own = {"query.policy": "none", "detect.channel": channel}
    return Case.from_toml(find_case(case)).track.replace({**own, **keys})


def detect_flight(recording: Recording, channel: str) -> Flight:
    """Detect the vehicles of a recorded simulation."""
    case = recording.case
    state, found = track.start(design_of(case.name, channel, {}), case.seed), []
    for frame, truth in zip(recording.sensor_frames(), recording.truths, strict=True):
        state, _ = track.step(state, frame)
        if state.grid is not None:
            found.append((frame.time_s, state.detections, state.grid, truth))
    return Flight(case.name, case.seed, channel, recording.extent_m, found)


def at_once(flight: Flight) -> LabelledTracks:
    """All that is followed, as it is known at each frame."""
    parts = []
    for state, (time_s, _, _, truth) in zip(flight.states(), flight.found, strict=True):
        primary = existence.primary_targets(state.duplicates, state.targets)
        shown = state.targets.confirmed & (primary == np.arange(len(primary)))
        features = existence.existence_features(state.targets, state.flow, time_s, primary)[shown]
        every = select(existence.move_to_mean_position(state.targets, primary), shown)
        tracks = reporting.tracks_to_dataset(time_s, every.id, every.mean, every.covariance, every.misses > 0)
        parts.append(label_tracks(tracks, features, truth, flight.extent_m))
    return concatenate_tracks(parts[SETTLED_FRAMES:])


def later(flight: Flight) -> LabelledTracks:
    """Tracks that may be reported for each frame, `LAG_S` later."""
    moments, parts = [], []
    for state in flight.states({"reporting.lag_s": LAG_S}):
        moments.append(reporting.pending_epoch(moments[-1] if moments else None, state, track.report(state)))
    for k, (time_s, _, _, truth) in enumerate(flight.found):
        known = [one for one in moments[k:] if one.time_s <= time_s + LAG_S + 1e-6]
        if known[-1].time_s - time_s >= LAG_S - 1e-6:
            found = reporting.report_candidates(known)
            parts.append(label_tracks(found.dataset(time_s), found.features, truth, flight.extent_m))
    return concatenate_tracks(parts[SETTLED_FRAMES:])


def label_tracks(tracks: xr.Dataset, features: np.ndarray, truth: xr.Dataset, extent_m) -> LabelledTracks:
    """Features of the tracks of a frame that are right or false."""
    score = metrics.score_epoch(tracks, truth, extent_m)
    known = score.valid | score.false
    return features[known], score.valid[known].astype(float)


def concatenate_tracks(parts: Sequence[LabelledTracks]) -> LabelledTracks:
    """All of them."""
    features, right = zip(*parts, strict=True)
    return np.concatenate(features), np.concatenate(right)


def fit_tracks(sets: Sequence[LabelledTracks]) -> np.ndarray:
    """Intercept and weights of the log odds, from flights that weigh the same."""
    features, right = concatenate_tracks(sets)
    weight = np.concatenate([np.full(len(y), 1 / len(y)) for _, y in sets]) / len(sets)
    return fit_logistic(features, right, weight)


def write(name: str, fitted: Mapping[str, np.ndarray]) -> None:
    """Put fitted models into a calibration file."""
    old = read_calibration(name)
    models = {
        channel: LogisticModel(old.models[channel].features, float(w[0]), w[1:])
        for channel, w in fitted.items()
    }
    valid = EXISTENCE_VALID | {key: old.valid[key] for key in ("lag_s",) if key in old.valid}
    found = replace(old, source="tools/calibrate.py existence", valid=valid, models=models)
    write_calibration(name, found)


def calibrate_existence() -> None:
    """Fit the existence models without and with a lag, and write both files."""
    flown: dict[str, list[Flight]] = {channel: [] for channel in CHANNELS}
    for flight, changes in EXISTENCE_FLIGHTS:
        recording = record_flight(flight, changes)
        for channel in CHANNELS:
            flown[channel].append(detect_flight(recording, channel))
    for name, labelled in (("existence", at_once), ("existence_smoothed", later)):
        fitted = {
            channel: fit_tracks([labelled(one) for one in flights]) for channel, flights in flown.items()
        }
        write(name, fitted)
        for channel, model in read_calibration(name).models.items():
            print(channel, model.intercept, dict(zip(model.features, model.weights.tolist(), strict=True)))


def main() -> None:
    """Fit the models that are named."""
    parts = {"mosaic": calibrate_mosaic, "existence": calibrate_existence}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=parts)
    parts[parser.parse_args().part]()


if __name__ == "__main__":
    main()
