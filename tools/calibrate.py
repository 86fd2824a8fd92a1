"""Train the detector `mosaic` and the tracker: ``python tools/calibrate.py FOLDER``.

1. *Record* the flights of the plan (`plan_flights`) into the folder, but those that it holds. A Latin
   hypercube covers four kinds of traffic and two of cities, rates, angles, pitches, hazes and azimuths.
   Flights of packaged cases and of arrays without polarizers are added.
2. *Detector*: label the peaks of each flight in each channel by the truth. One peak of a visible moving
   vehicle is a vehicle, what is far from every vehicle is clutter, the rest says nothing. A model of
   `mosaic_peaks.FEATURES` is fitted; every flight and, within it, vehicles and clutter weigh the same.
   Residuals of the likely peaks give height and standard deviations. Masks and places are those of the
   present model: run it twice after a change of the detector.
3. *Reporting*: label every confirmed track at every frame by the truth, as the scores do: right or false. A
   track that moves near a standing vehicle says nothing. A model of `existence.existence_features` is
   fitted to each channel; then one of `reporting.report_candidates`, 1.5 s later.
4. *Check*: track held-out flights, and print the share of false tracks where 10 % may be false.

``--only`` names some steps. Fits are maximum likelihood with a weak ridge and go to ``data/calibration``.
"""

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.optimize import linear_sum_assignment, minimize
from scipy.special import expit
from scipy.stats import qmc

sys.path.insert(0, str(Path(__file__).parents[1]))
from glintrack import metrics, track
from glintrack.case.design import Case
from glintrack.io.atomic import content_hash
from glintrack.io.toml import to_toml
from glintrack.track import existence, reporting
from glintrack.track.calibration import Calibration, LogisticModel, calibration_file, read_calibration
from glintrack.track.design import DetectDesign
from glintrack.track.detect.detections import Association
from glintrack.track.detect.frame import grid_of
from glintrack.track.detect.mosaic import MosaicDetector, SearchedMosaic
from glintrack.track.detect.mosaic_peaks import FEATURES, MIN_RATIO
from glintrack.track.initiation import select
from tools.record_flight import Recording, case_of, read_recording, record_case, write_recording

CHANNELS = ("pan", "dolp", "all")
RIDGE, MIN_LABELS = 1e-3, 20  # a flight with fewer vehicles says nothing
SOURCE = "tools/calibrate.py"


def write_calibration(name: str, calibration: Calibration) -> None:
    """Write a calibration with rounded weights, and forget the one read before."""
    models = {}
    for key, model in calibration.models.items():
        own = {name: round(float(w), 2) for name, w in zip(model.features, model.weights, strict=True)}
        models[key] = {"intercept": round(float(model.intercept), 2), "weights": own}
    values = {"source": calibration.source, "valid": dict(calibration.valid), "models": models}
    values |= {"constants": dict(calibration.constants)} if calibration.constants else {}
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


# ---- flights

RATE_HZ, OFF_NADIR_DEG, SLANT_RANGE_M = (1.0, 10.0), (3.0, 60.0), 3000.0
CHECKED_RATE_HZ = 1.5, 10.0  # in cities at 1 Hz a third of the reported tracks are false
KINDS = ("motorway", "arterial", "junction", "suburb", "quickstart", "embedded")
PITCHES = (  # small arrays, so that a flight takes less than a minute
    ("sensor.pitch_um=17.0", "sensor.rows=160", "sensor.columns=400"),
    ("sensor.pitch_um=12.0", "sensor.rows=180", "sensor.columns=480"),
    (
        "sensor.pitch_um=8.5", "sensor.rows=200", "sensor.columns=560", "sensor.spot_sigma_um=12",
        "sensor.full_well_e=267e3", "sensor.read_noise_e=20", "sensor.integration_time_ms=0.085",
    ),
)  # fmt: skip
HAZES = ("clear", "urban")
_NADIR = ("flight.off_nadir_deg=8.0", "flight.altitude_m=2970.0")
_PAN = (
    'channels=["pan"]',
    'sensor.layout="pan"',
    'sensor.demosaic="superpixel"',
    "flight.frames=20",
    *PITCHES[0],
)
PACKAGED = (
    ("quickstart:11", ()), ("braunschweig:11", ()), ("suburb:1", ()), ("motorway:1", ()), ("arterial:1", ()),
    ("junction:1", ()), ("arterial:1", _NADIR), ("motorway:1", _NADIR), ("quickstart:12", _PAN),
    ("suburb:2", _PAN),
)  # fmt: skip

Planned = tuple[str, tuple[str, ...]]  # flight and changes of `record_flight.case_of`


def plan_flights() -> tuple[Planned, ...]:
    """Flights that train the models."""
    return (*PACKAGED, *_hypercube(24, 300, 0))


def held_out_flights() -> tuple[Planned, ...]:
    """Flights with other seeds and other parts of the recorded traffic, which train nothing."""
    return _hypercube(8, 400, 25)


def _hypercube(count: int, first_seed: int, start_s: int) -> tuple[Planned, ...]:
    """Flights of a Latin hypercube; rates rise so that half are below 2.3 Hz."""
    flights = []
    sample = qmc.LatinHypercube(7, optimization="random-cd", seed=first_seed).random(count)
    for seed, (rate, angle, pitch, haze, azimuth, start, kind) in enumerate(sample, first_seed):
        rate_hz = round(RATE_HZ[1] ** rate**1.5, 1)
        off_nadir_deg = round(OFF_NADIR_DEG[0] + (OFF_NADIR_DEG[1] - OFF_NADIR_DEG[0]) * angle, 1)
        name = KINDS[int(len(KINDS) * kind)]
        changes = (
            f"flight.rate_hz={rate_hz}", f"sensor.max_frame_rate_hz={rate_hz}",
            f"flight.frames={min(max(14, round(6 * rate_hz)), 44)}", f"flight.off_nadir_deg={off_nadir_deg}",
            f"flight.altitude_m={SLANT_RANGE_M * math.cos(math.radians(off_nadir_deg)):.1f}",
            f"flight.azimuth_from_sun_deg={round(360 * azimuth) - 180}.0", *PITCHES[int(3 * pitch)],
            f'atmosphere.aerosol="{HAZES[int(2 * haze)]}"', "scene.material_variation=1",
        )  # fmt: skip
        if name != "embedded":  # whose own seed drives other traffic
            changes += (f"scene.seed={seed}", f"flight.start_s={round(20 * start) + start_s}.0")
        flights.append((f"{name}:{seed}", changes))
    return tuple(flights)


def recorded(folder: Path, flight: str, changes: tuple[str, ...]) -> Recording:
    """Read a flight's recording, or simulate it and write one."""
    path = folder / f"{flight.replace(':', '-')}-{content_hash(' '.join(changes), 8)}.nc"
    case = case_of(flight, changes)
    if not path.exists():
        write_recording(path, record_case(case))
    return read_recording(path, case)


def record(folder: Path) -> None:
    """Record all flights."""
    for flight, changes in (*plan_flights(), *held_out_flights()):
        recorded(folder, flight, changes)


def channels_of(recording: Recording) -> tuple[str, ...]:
    """Channels that a recording trains."""
    return CHANNELS if recording.case.sensor.has_stokes else ("pan",)


def validity(more: Mapping[str, object]) -> dict[str, object]:
    """Range in which the models hold."""
    names = [" ".join((name, *changes)) for name, changes in PACKAGED]
    return {
        "detector": "mosaic", "gsd_m": [0.375, 0.75], "rate_hz": list(CHECKED_RATE_HZ),
        "off_nadir_deg": list(OFF_NADIR_DEG), **more,
        "flights": [*names, "24 of a Latin hypercube (tools/calibrate.py)"],
    }  # fmt: skip


# ---- detector `mosaic`

SETTLED_S = 4.0  # before it the ground is still being learnt
LIKELY = 3.0  # nat from which a peak's place counts among the residuals


@dataclass(frozen=True)
class Peaks:
    """Peaks of some flights: features, 1 for vehicles and 0 for clutter, and residuals of the vehicles.

    Residuals are those of the place seen: away from the camera, over the tangent of the off-nadir angle,
    which is a height; and across. [m]
    """

    features: np.ndarray
    vehicle: np.ndarray
    residual_m: np.ndarray


def label_flight(recording: Recording, channel: str) -> Peaks:
    """Collect the peaks of a simulation in a channel, after background learning."""
    detector, state, times_s, parts = MosaicDetector(DetectDesign()), None, [], []
    for frame, truth in zip(recording.frames, recording.truths, strict=True):
        frame = frame_for(frame, channel, frame.time_s - times_s[-1] if times_s else 0.0)
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        times_s.append(frame.time_s)
        if frame.time_s - times_s[0] >= SETTLED_S:
            parts.append(label_peaks(found.detail, frame.pose, truth, recording.extent_m))
        nobody = Association(np.zeros(len(found), bool))
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


def fit_detector(folder: Path) -> None:
    """Fit the models of peaks, and write ``mosaic.toml``."""
    data: dict[str, list[Peaks]] = {channel: [] for channel in CHANNELS}
    for planned in plan_flights():
        recording = recorded(folder, *planned)
        for channel in channels_of(recording):
            data[channel].append(label_flight(recording, channel))
    data = {
        channel: [one for one in sets if one.vehicle.sum() >= MIN_LABELS] for channel, sets in data.items()
    }
    laws = {channel: fit_peaks(sets) for channel, sets in data.items()}
    shares = {channel: detection_ratio(sets, laws[channel]) for channel, sets in data.items()}
    places = {channel: residuals(concatenate_peaks(sets), laws[channel]) for channel, sets in data.items()}
    print(shares, places)
    models = {channel: LogisticModel(FEATURES[channel], law[0], law[1:]) for channel, law in laws.items()}
    ratios = {channel: round(share, 2) for channel, share in shares.items()}
    constants = {**read_calibration("mosaic").constants, "place": places, "detection_ratio": ratios}
    valid = validity({"layout": "mirror-0-60-120", "max_speed_m_s": [22.0]})
    write_calibration("mosaic", Calibration(SOURCE, valid, models, constants))


# ---- existence models of the tracker

SETTLED_FRAMES = 4  # before it next to nothing is confirmed
LAG_S = 1.5
ALLOWED = 0.1  # share of false tracks in the check

LabelledTracks = tuple[np.ndarray, np.ndarray]  # features, and 1 for right and 0 for false tracks


@dataclass(frozen=True)
class Flight:
    """Detections of a simulation in a channel: time, detections, grid and truth of each frame."""

    case: Case
    channel: str
    extent_m: tuple[float, float, float, float]
    found: list[tuple[float, track.Detections, track.Grid, xr.Dataset]]

    def states(self, keys: Mapping[str, object] | None = None) -> Iterator[track.TrackerState]:
        """Yield the tracker after each frame, with some keys changed."""
        state = track.start(design_of(self.case, self.channel, keys or {}), self.case.seed)
        for time_s, one, grid, _ in self.found:
            state = track.step_detections(state, one, time_s, grid)
            yield state


def design_of(case: Case, channel: str, keys: Mapping[str, object]) -> track.TrackDesign:
    """Make a case's tracker of a channel, with some keys changed."""
    return case.track.replace({"query.policy": "none", "detect.channel": channel, **keys})


def detect_flight(recording: Recording, channel: str) -> Flight:
    """Detect the vehicles of a recorded simulation."""
    case = recording.case
    state, found = track.start(design_of(case, channel, {}), case.seed), []
    for frame, truth in zip(recording.frames, recording.truths, strict=True):
        state, _ = track.step(state, frame)
        if state.grid is not None:
            found.append((frame.time_s, state.detections, state.grid, truth))
    return Flight(case, channel, recording.extent_m, found)


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
    times = np.array([one.time_s for one in moments])
    for k, (time_s, _, _, truth) in enumerate(flight.found):
        due = np.searchsorted(times, time_s + LAG_S - 1e-6)
        if due < len(times):
            found = reporting.report_candidates(moments[k : due + 1])
            parts.append(label_tracks(found.dataset(time_s), found.features, truth, flight.extent_m))
    return concatenate_tracks(parts[SETTLED_FRAMES:])


def label_tracks(tracks: xr.Dataset, features: np.ndarray, truth: xr.Dataset, extent_m) -> LabelledTracks:
    """Features of the tracks that are right or false; one that stands near any vehicle is right."""
    score = metrics.score_epoch(tracks, truth, extent_m)
    stands = np.hypot(tracks["east_speed_m_s"], tracks["north_speed_m_s"]).values < metrics.MOVING_SPEED_M_S
    known = score.valid | score.false | stands
    return features[known], 1.0 - score.false[known]


def concatenate_tracks(parts: Sequence[LabelledTracks]) -> LabelledTracks:
    """All of them."""
    features, right = zip(*parts, strict=True)
    return np.concatenate(features), np.concatenate(right)


def fit_tracks(sets: Sequence[LabelledTracks]) -> np.ndarray:
    """Intercept and weights of the log odds; a flight weighs as the power 3/4 of its labels."""
    features, right = concatenate_tracks(sets)
    weight = np.concatenate([np.full(len(y), len(y) ** -0.25) for _, y in sets])
    return fit_logistic(features, right, weight / weight.sum())


def fit_reporting(folder: Path) -> None:
    """Fit the existence models without and with a lag, and write both files."""
    flown: dict[str, list[Flight]] = {channel: [] for channel in CHANNELS}
    for planned in plan_flights():
        recording = recorded(folder, *planned)
        for channel in channels_of(recording):
            flown[channel].append(detect_flight(recording, channel))
    for name, labelled in (("existence", at_once), ("existence_smoothed", later)):
        old, models = read_calibration(name), {}
        for channel, flights in flown.items():
            sets = [one for one in map(labelled, flights) if one[1].sum() >= MIN_LABELS]
            law = fit_tracks(sets)
            models[channel] = LogisticModel(old.models[channel].features, float(law[0]), law[1:])
        lag = {"lag_s": [LAG_S]} if name == "existence_smoothed" else {}
        valid = validity({"speed_m_s": [0.0, 33.0], **lag})
        write_calibration(name, replace(old, source=SOURCE, valid=valid, models=models))


def check(folder: Path) -> None:
    """Print completeness and share of false tracks of the held-out flights, where 10 % may be false."""
    for planned in held_out_flights():
        recording = recorded(folder, *planned)
        for channel in channels_of(recording):
            flight = detect_flight(recording, channel)
            reports = track.report_epochs(flight.states({"reporting.max_false_share": ALLOWED}))
            pairs = list(zip(reports, flight.found, strict=True))[SETTLED_FRAMES:]
            scores = [metrics.score_epoch(one, truth, flight.extent_m) for one, (*_, truth) in pairs]
            right, false, visible = (
                sum(int(getattr(one, name).sum()) for one in scores) for name in ("valid", "false", "visible")
            )
            print(
                f"{planned[0]:16}{channel:6}{visible:6} visible{right / max(visible, 1):6.2f} reported"
                f"{false / max(right + false, 1):7.3f} false", flush=True
            )  # fmt: skip


def main() -> None:
    """Run the steps that are named."""
    steps = {"record": record, "detector": fit_detector, "reporting": fit_reporting, "check": check}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="recordings, about 1 GB")
    parser.add_argument("--only", nargs="+", choices=steps, default=list(steps))
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name in arguments.only:
        steps[name](arguments.folder)


if __name__ == "__main__":
    main()
