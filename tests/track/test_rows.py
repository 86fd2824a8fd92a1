"""One vehicle one track, two vehicles two tracks, a lorry with trailer one: from detections alone."""

from functools import cache

import numpy as np
import pytest

from glintrack import track

AREA = track.Grid((500, 800), (-100.0, 650.0), 1.5)
INTERVAL_S, SIGMA_M, DETECTED, LANE_M = 0.5, 0.5, 0.85, 3.2


def row(count, gap_m, lanes=1):
    """Positions of vehicles in lanes side by side, from west to east. [m]"""
    return np.array([(gap_m * k, LANE_M * lane) for lane in range(lanes) for k in range(count)])


# positions, speed [m/s], expected tracks
GROUPS = {
    "car": (row(1, 0.0), 8.0, 1),
    "lorry": (row(2, 5.0), 8.0, 1),
    "lorry and trailer": (row(3, 4.0), 8.0, 1),
    "8 m in one lane": (row(2, 8.0), 7.0, 2),
    "12 m in one lane": (row(2, 12.0), 10.0, 2),
    "6 m in two lanes": (np.array([(0.0, 0.0), (6.0, LANE_M)]), 8.0, 2),
    "8 m in two lanes": (np.array([(0.0, 0.0), (8.0, LANE_M)]), 8.0, 2),
    "12 m in two lanes": (np.array([(0.0, 0.0), (12.0, LANE_M)]), 8.0, 2),
    "row, 8 m": (row(5, 8.0), 8.0, 5),
    "row, 12 m": (row(5, 12.0), 10.0, 5),
    "two rows, 6 m": (row(5, 6.0, 2), 8.0, 10),
    "two rows, 8 m": (row(5, 8.0, 2), 8.0, 10),
    "two rows, 12 m": (row(5, 12.0, 2), 10.0, 10),
}


# the existence model of `all` takes cars 6 m apart in neighbouring lanes for one vehicle
MERGED = ("all", "6 m in two lanes"), ("all", "two rows, 6 m")


@cache
def tracks_of_groups(channel):
    """Mean number of reported tracks within 6 m of each group, 40 m apart from south to north."""
    rng, first = np.random.default_rng(0), np.array([len(places) for places, _, _ in GROUPS.values()])
    start = np.concatenate([p + [0.0, 45.0 * k] for k, (p, _, _) in enumerate(GROUPS.values())])
    speed = np.repeat([v for _, v, _ in GROUPS.values()], first)
    velocity = np.stack([speed, np.zeros_like(speed)], axis=-1)
    design = track.TrackDesign().replace({"query.policy": "none", "detect.channel": channel})
    state, states, truths = track.start(design), [], []
    for k in range(24):
        place = start + velocity * INTERVAL_S * k
        seen = rng.random(len(place)) < DETECTED
        n = int(seen.sum())
        found = track.Detections(
            place[seen] + rng.normal(0, SIGMA_M, (n, 2)), np.repeat(SIGMA_M**2 * np.eye(2)[None], n, 0),
            np.ones(n), np.ones(n), log_likelihood_ratio=np.minimum(rng.normal(2.5, 1.2, n), 3.7),
            velocity=velocity[seen] + rng.normal(0, 2.0, (n, 2)), velocity_sigma_m_s=2.0, velocity_share=0.7,
            velocity_most_m_s=22.0,
        )  # fmt: skip
        state = track.step_detections(state, found, INTERVAL_S * k, AREA)
        states.append(state)
        truths.append(np.split(place, np.cumsum(first)[:-1]))
    counts = []
    for reported, groups in list(zip(track.report_epochs(iter(states)), truths, strict=True))[8:]:
        at = np.stack([reported["east_m"].values, reported["north_m"].values], axis=-1)
        apart = [np.hypot(*(at[:, None] - one).transpose(2, 0, 1)).min(axis=1) for one in groups]
        counts.append([int((one < 6.0).sum()) for one in apart])
    return dict(zip(GROUPS, np.mean(counts, axis=0), strict=True))


@pytest.mark.parametrize(
    ("channel", "group"),
    [(channel, group) for channel in ("pan", "all") for group in GROUPS if (channel, group) not in MERGED],
)
def test_each_vehicle_has_one_track(channel, group):
    missed_share = 0.2  # the ends of a row look like ends of one vehicle
    assert tracks_of_groups(channel)[group] == pytest.approx(GROUPS[group][2], rel=missed_share)
