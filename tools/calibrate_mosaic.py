"""Fit the constants of the detector `mosaic` and write them to ``data/calibration/mosaic.toml``.

``python tools/calibrate_mosaic.py`` flies `quickstart` with seeds 11 and 12 (`tools/record_flight.py`),
each as it is, with elements of half the pitch and at 10 Hz, so that one law holds for all of them. It runs
the detector over each in each channel, over the sensor without polarizers too in `pan`, and labels the peaks
by the truth: one peak of a visible moving vehicle is a vehicle, what is far from every vehicle is clutter,
the rest says nothing. A logistic law of `mosaic_peaks.FEATURES` is fitted by maximum likelihood with a weak
ridge; every flight and, within it, vehicles and clutter weigh the same, which takes the flights' own odds
off. By it, what share of vehicles' and of clutter's peaks are told is counted. Residuals of the likely ones
give height and standard deviations. Masks and places of the flights are those of the law before: run it twice
after a change of the detector.
"""

from dataclasses import dataclass, replace

import numpy as np
from record_flight import Recording, recorded
from scipy.optimize import linear_sum_assignment, minimize
from scipy.special import expit

from glintrack.metrics import is_in_window, is_moving, is_visible
from glintrack.track.calibration import Calibration, LogisticModel, read_calibration, write_calibration
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Association
from glintrack.track.detect.frame import grid_of
from glintrack.track.detect.mosaic import MosaicDetector, SearchedMosaic
from glintrack.track.detect.mosaic_peaks import FEATURES, MIN_RATIO

CHANNELS = ("pan", "dolp", "all")
FLIGHTS = {"quickstart:11": ("flight.azimuth_from_sun_deg=0",), "quickstart:12": ()}
VARIANTS = (
    ("flight.frames=24",),
    ("flight.frames=24", "sensor.pitch_um=8.5", "sensor.rows=1120", "sensor.columns=1760"),
    ("flight.frames=60", "flight.rate_hz=10", "sensor.clock_hz=10"),
)
SETTLED_S = 4.0  # before it the ground is still being learnt
RIDGE = 1e-3
LIKELY = 3.0  # nat from which a peak's place counts among the residuals
# where the fit holds
VALID = {
    "detector": "mosaic", "pitch_um": [8.5, 17.0], "rate_hz": [2.0, 10.0], "off_nadir_deg": [50.0],
    "max_speed_m_s": 22.0, "flights": ["quickstart 11", "quickstart 12"],
}  # fmt: skip


@dataclass(frozen=True)
class Labelled:
    """Peaks of some flights: features, 1 for vehicles and 0 for clutter, and residuals of the vehicles.

    Residuals are those of the place seen: away from the camera, over the tangent of the off-nadir angle,
    which is a height; and across. [m]
    """

    features: np.ndarray
    vehicle: np.ndarray
    residual_m: np.ndarray


def labelled(recording: Recording, sensor: str, channel: str) -> Labelled:
    """The peaks of a flight, as a sensor saw it, in a channel, once the ground is learnt."""
    detector, state, times_s, parts = MosaicDetector(DetectDesign()), None, [], []
    for frame, truth in zip(recording.seen(sensor), recording.truths, strict=True):
        frame = frame_for(frame, channel, frame.time_s - times_s[-1] if times_s else 0.0)
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        times_s.append(frame.time_s)
        if frame.time_s - times_s[0] >= SETTLED_S:
            parts.append(_label(found.detail, frame.pose, truth, recording.extent_m))
        nobody = Association(np.zeros(len(found), bool), np.empty((0, 2)))
        state = detector.update(state, frame, found, nobody)
    return joined(parts)


def frame_for(frame, channel: str, interval_s: float):
    """The frame as the tracker hands it to a detector."""
    return replace(frame, grid=grid_of(frame, None), channel=channel, interval_s=interval_s)


def joined(parts: list[Labelled]) -> Labelled:
    """All of them."""
    columns = zip(*((p.features, p.vehicle, p.residual_m) for p in parts), strict=True)
    return Labelled(*(np.concatenate(column) for column in columns))


def _label(seen: SearchedMosaic, pose, truth, extent_m) -> Labelled:
    if len(seen.peaks) == 0:
        return Labelled(seen.peaks.features, np.empty(0), np.empty((0, 2)))
    vehicle_m = np.stack([truth["east"].values, truth["north"].values], axis=-1)
    wanted = np.asarray(is_in_window(truth, extent_m) & is_moving(truth) & is_visible(truth))
    reach_m = np.maximum(4.0, truth["length"].values / 2 + 1)
    off_m = pose.position[:2] - seen.place_m
    slope = np.hypot(*off_m.T) / pose.up_m
    toward = off_m / np.hypot(*off_m.T)[:, None]
    standing_m = seen.place_m + (read_calibration("mosaic").constants["height_m"] * slope)[:, None] * toward
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
    return Labelled(seen.peaks.features[index], label, residual)


def fit(sets: list[Labelled]) -> np.ndarray:
    """Intercept and weights of the logarithm of the likelihood ratio, from flights that weigh the same."""
    data = joined(sets)
    scale = data.features.std(axis=0)
    x = np.column_stack([np.ones(len(data.vehicle)), data.features / scale])
    y = data.vehicle
    weight = np.concatenate(
        [np.where(one.vehicle > 0, 0.5 / one.vehicle.sum(), 0.5 / (1 - one.vehicle).sum()) for one in sets]
    ) / len(sets)

    def loss(w):
        z = x @ w
        value = weight @ (np.logaddexp(0, z) - y * z) + RIDGE * np.mean(w[1:] ** 2)
        slope = x.T @ (weight * (expit(z) - y))
        return value, slope + 2 * RIDGE * np.r_[0, w[1:]] / (len(w) - 1)

    w = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return np.r_[w[0], w[1:] / scale]


def detection_ratio(sets: list[Labelled], law: np.ndarray) -> float:
    """Log ratio of the shares of vehicles and of clutter that are detected, mean over flights."""
    ratios = []
    for data in sets:
        strong = law[0] + data.features @ law[1:] > MIN_RATIO
        vehicle = data.vehicle > 0
        ratios.append(np.log(np.mean(strong[vehicle]) / max(np.mean(strong[~vehicle]), 1e-6)))
    return float(np.mean(ratios))


def residuals(data: Labelled, law: np.ndarray) -> dict[str, float]:
    """Height of what is seen, and standard deviations, from quantiles: some peaks are of another vehicle."""
    ratio = law[0] + data.features[data.vehicle > 0] @ law[1:]
    height, across = data.residual_m[ratio > LIKELY].T
    share = 2 * 0.674489750196082  # of a Gaussian between its quartiles
    spread = [np.subtract(*np.quantile(r, [0.75, 0.25])) / share for r in (height, across)]
    # along the line of sight the error of the peak itself adds to that of the height
    return {
        "height_m": float(np.median(height)),
        "height_sigma_m": float(spread[0]),
        "sigma_m": float(spread[1]),
    }


def write(laws: dict[str, np.ndarray], shares: dict[str, float], constants: dict[str, float]) -> None:
    """Write ``data/calibration/mosaic.toml``."""
    models = {channel: LogisticModel(FEATURES, law[0], law[1:]) for channel, law in laws.items()}
    rounded = {name: round(value, 2) for name, value in constants.items()}
    ratios = {channel: round(share, 2) for channel, share in shares.items()}
    write_calibration(
        "mosaic",
        Calibration("tools/calibrate_mosaic.py", VALID, models, {**rounded, "detection_ratio": ratios}),
    )


def main() -> None:
    """Fly, fit, write."""
    data: dict[str, list[Labelled]] = {channel: [] for channel in CHANNELS}
    for flight, azimuth in FLIGHTS.items():
        for changes in VARIANTS:
            recording = recorded(flight, (*azimuth, *changes))
            for channel in CHANNELS:
                data[channel].append(labelled(recording, "flown", channel))
            data["pan"].append(labelled(recording, "pan", "pan"))
    laws = {channel: fit(sets) for channel, sets in data.items()}
    shares = {channel: detection_ratio(sets, laws[channel]) for channel, sets in data.items()}
    constants = residuals(joined(data["all"]), laws["all"])
    for channel, law in laws.items():
        found = joined(data[channel]).vehicle
        print(
            f"{channel}: {np.round(law, 2)}, {int(found.sum())} vehicles, {int((1 - found).sum())} of clutter"
        )
    print(shares, constants)
    write(laws, shares, constants)


if __name__ == "__main__":
    main()
