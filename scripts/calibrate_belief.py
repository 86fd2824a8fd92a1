"""Fit by what a followed track is taken for a vehicle, and write it into its module.

``python scripts/calibrate_belief.py`` flies `quickstart` with seeds 11 and 12 and `braunschweig` with seed
11 (`scripts/record_flight.py`), follows them in each channel with the tracker of the packaged case, reporting
all that is confirmed, and labels every track at every frame by the truth, as the scores do: right or false;
what is beside a standing vehicle says nothing. A logistic law of `belief.FEATURES` is fitted to each channel
by maximum likelihood with a weak ridge, every flight weighing the same.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from record_flight import Recording, recorded
from scipy.optimize import minimize
from scipy.special import expit

from glintrack import metrics, track
from glintrack.config import Case, find_case
from glintrack.track import belief
from glintrack.track.design import NEVER_DOUBTED

FLIGHTS = ("quickstart:11", "quickstart:12", "braunschweig:11")
CHANNELS = ("pan", "dolp", "all")
SETTLED_FRAMES = 4  # before it next to nothing is confirmed
RIDGE = 1e-3

Labelled = tuple[np.ndarray, np.ndarray]  # features of tracks at frames, and 1 for right and 0 for false ones


def design_of(case: str, channel: str) -> track.TrackDesign:
    """The packaged case's tracker, which reports all that it follows."""
    own = {
        "query.policy": "none",
        "detect.channel": channel,
        "initiation.report_false_per_km2": NEVER_DOUBTED,
    }
    return Case.from_toml(find_case(case)).track.replace({**own, **belief.FOLLOW})


def labelled(recording: Recording, channel: str) -> Labelled:
    """The tracks of a flight at each frame."""
    state, parts = track.start(design_of(recording.case.name, channel), recording.case.seed), []
    for frame, truth in zip(recording.seen(), recording.truths, strict=True):
        state, _ = track.step(state, frame)
        parts.append(label(state, truth, recording.extent_m))
    return joined(parts[SETTLED_FRAMES:])


def label(state: track.TrackerState, truth, extent_m) -> Labelled:
    """The tracks of a frame that are right or false."""
    score = metrics.score_epoch(track.report(state), truth, extent_m)
    known = score.valid | score.false
    return belief.features(state.targets)[state.targets.confirmed][known], score.valid[known].astype(float)


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


def write(laws: Mapping[str, np.ndarray]) -> None:
    """Put them into the module that the tracker reads."""
    path = Path(belief.__file__)
    text = path.read_text(encoding="utf-8")
    head, rest = text.split("LAW = {\n", 1)
    tail = rest[rest.index("# end of what is calibrated") :]
    rows = [f'    "{name}": ({", ".join(f"{w:.2f}" for w in law)}),\n' for name, law in laws.items()]
    path.write_text("".join([head, "LAW = {\n", *rows, "}\n", tail]), encoding="utf-8")


def main() -> None:
    """Fly, follow, fit, write."""
    sets: dict[str, list[Labelled]] = {channel: [] for channel in CHANNELS}
    for flight in FLIGHTS:
        recording = recorded(flight)
        for channel in CHANNELS:
            sets[channel].append(labelled(recording, channel))
    laws = {channel: fit(of) for channel, of in sets.items()}
    for channel, law in laws.items():
        print(channel, dict(zip(("1", *belief.FEATURES), np.round(law, 2).tolist(), strict=True)))
    write(laws)


if __name__ == "__main__":
    main()
