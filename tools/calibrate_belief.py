"""Fit the existence models, without and with a fixed lag, and write them to ``data/calibration``.

``python tools/calibrate_belief.py`` flies `quickstart` with seeds 11 and 12 and `braunschweig` with seed
11 (`tools/record_flight.py`), follows them in each channel with the tracker of the packaged case, reporting
all that is confirmed, and labels every track at every frame by the truth, as the scores do: right or false;
what is beside a standing vehicle says nothing. A logistic model of `existence.existence_features` is fitted
to each channel by maximum likelihood with a weak ridge, every flight weighing the same; then one of the
features of `reporting.report_candidates`, 1.5 s later.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from record_flight import Recording, recorded
from scipy.optimize import minimize
from scipy.special import expit

from glintrack import metrics, track
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.track import existence, reporting
from glintrack.track.calibration import LogisticModel, read_calibration, write_calibration
from glintrack.track.design import CONFIRMATION_RULES

FLIGHTS = ("quickstart:11", "quickstart:12", "braunschweig:11")
CHANNELS = ("pan", "dolp", "all")
SETTLED_FRAMES = 4  # before it next to nothing is confirmed
RIDGE = 1e-3

LAG_S = 1.5
RULES = {f"initiation.{key}": value for key, value in CONFIRMATION_RULES.items()}

Labelled = tuple[np.ndarray, np.ndarray]  # features of tracks at frames, and 1 for right and 0 for false ones


@dataclass(frozen=True)
class Flight:
    """What a packaged case detected in a channel: time, detections, grid and truth of each frame."""

    case: str
    seed: int
    channel: str
    extent_m: tuple[float, float, float, float]
    found: list[tuple[float, track.Detections, track.Grid, xr.Dataset]]

    def states(self, keys: Mapping[str, object] | None = None) -> Iterator[track.TrackerState]:
        """The tracker after each frame, with some keys changed."""
        state = track.start(design_of(self.case, self.channel, keys or {}), self.seed)
        for time_s, one, grid, _ in self.found:
            state = track.step_detections(state, one, time_s, grid)
            yield state


def design_of(case: str, channel: str, keys: Mapping[str, object]) -> track.TrackDesign:
    """The packaged case's tracker of a channel, with some keys changed."""
    own = {"query.policy": "none", "detect.channel": channel}
    return Case.from_toml(find_case(case)).track.replace({**own, **keys})


def detected(recording: Recording, channel: str) -> Flight:
    """What the packaged case detects in a flight."""
    case = recording.case
    state, found = track.start(design_of(case.name, channel, {}), case.seed), []
    for frame, truth in zip(recording.seen(), recording.truths, strict=True):
        state, _ = track.step(state, frame)
        if state.grid is not None:
            found.append((frame.time_s, track.detections(state), state.grid, truth))
    return Flight(case.name, case.seed, channel, recording.extent_m, found)


def at_once(flight: Flight) -> Labelled:
    """All that is followed, as it is known at each frame."""
    states, parts = flight.states(RULES | {"reporting.method": "confirmation"}), []
    for state, (_, _, _, truth) in zip(states, flight.found, strict=True):
        features = existence.existence_features(state.targets)[state.targets.confirmed]
        parts.append(label(track.report(state), features, truth, flight.extent_m))
    return joined(parts[SETTLED_FRAMES:])


def later(flight: Flight) -> Labelled:
    """What may be reported of each frame `LAG_S` later."""
    moments, parts = [], []
    for state in flight.states({"reporting.lag_s": LAG_S}):
        moments.append(reporting.pending_epoch(moments[-1] if moments else None, state, track.report(state)))
    for k, (time_s, _, _, truth) in enumerate(flight.found):
        known = [one for one in moments[k:] if one.time_s <= time_s + LAG_S + 1e-6]
        if known[-1].time_s - time_s >= LAG_S - 1e-6:
            found = reporting.report_candidates(known)
            parts.append(label(found.dataset(time_s), found.features, truth, flight.extent_m))
    return joined(parts[SETTLED_FRAMES:])


def label(tracks: xr.Dataset, features: np.ndarray, truth: xr.Dataset, extent_m) -> Labelled:
    """Features of the tracks of a frame that are right or false."""
    score = metrics.score_epoch(tracks, truth, extent_m)
    known = score.valid | score.false
    return features[known], score.valid[known].astype(float)


def joined(parts: Sequence[Labelled]) -> Labelled:
    """All of them."""
    features, right = zip(*parts, strict=True)
    return np.concatenate(features), np.concatenate(right)


def fit(sets: Sequence[Labelled]) -> np.ndarray:
    """Intercept and weights of the log odds, from flights that weigh the same."""
    features, right = joined(sets)
    scale = np.maximum(features.std(axis=0), 1e-9)
    x = np.column_stack([np.ones(len(right)), features / scale])
    weight = np.concatenate([np.full(len(y), 1 / len(y)) for _, y in sets]) / len(sets)

    def loss(w):
        z = x @ w
        value = weight @ (np.logaddexp(0, z) - right * z) + RIDGE * np.mean(w[1:] ** 2)
        return value, x.T @ (weight * (expit(z) - right)) + 2 * RIDGE * np.r_[0, w[1:]] / (len(w) - 1)

    w = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return np.r_[w[0], w[1:] / scale]


def write(name: str, fitted: Mapping[str, np.ndarray]) -> None:
    """Put fitted models into a calibration file."""
    old = read_calibration(name)
    models = {
        channel: LogisticModel(old.models[channel].features, float(w[0]), w[1:])
        for channel, w in fitted.items()
    }
    write_calibration(name, replace(old, models=models))


def main() -> None:
    """Fly, follow, fit, write."""
    flown: dict[str, list[Flight]] = {channel: [] for channel in CHANNELS}
    for flight in FLIGHTS:
        recording = recorded(flight)
        for channel in CHANNELS:
            flown[channel].append(detected(recording, channel))
    for name, labelled in (("existence", at_once), ("existence_smoothed", later)):
        fitted = {channel: fit([labelled(one) for one in flights]) for channel, flights in flown.items()}
        write(name, fitted)
        for channel, model in read_calibration(name).models.items():
            print(channel, model.intercept, dict(zip(model.features, model.weights.tolist(), strict=True)))


if __name__ == "__main__":
    main()
