"""A vehicle that stops keeps its track, which is reported as stopped until it moves on."""

import numpy as np

from glintrack import track
from tests.track.detect import mosaic_flight

START_S, BRAKING_M_S2, STAND_S = 4.0, 3.0, 6.0
STOP_S = START_S + mosaic_flight.SPEED_M_S / BRAKING_M_S2


def travel(t):
    """Way of a vehicle that drives, brakes and stands. [m]"""
    braking = np.clip(t - START_S, 0.0, STOP_S - START_S)
    return mosaic_flight.SPEED_M_S * (min(t, START_S) + braking) - 0.5 * BRAKING_M_S2 * braking**2


def reports(frames):
    """Tracks of each frame."""
    design = track.TrackDesign().replace({"query.policy": "none", "reporting.max_false_share": 0.5})
    state, states = track.start(design), []
    for frame in frames:
        state, _ = track.step(state, frame)
        states.append(state)
    return list(track.report_epochs(iter(states)))


def test_a_vehicle_that_stops_is_measured_and_stands():
    frames = round(2 * (STOP_S + STAND_S))
    told = reports(mosaic_flight.frames(frames, travel=travel))
    ids, speeds_m_s = {}, {}
    for k, one in enumerate(told):
        apart = np.hypot(one["east_m"].values + 25.0 - travel(0.5 * k), one["north_m"].values - 5.0)
        if len(apart) and apart.min() < 4.0:
            ids[0.5 * k] = int(one["track"][apart.argmin()])
            own = one.isel(track=apart.argmin())
            speeds_m_s[0.5 * k] = float(np.hypot(own["east_speed_m_s"], own["north_speed_m_s"]))
    standing = np.arange(np.ceil(2 * STOP_S) / 2, 0.5 * frames, 0.5)
    same = [ids.get(t) == ids[START_S] for t in standing]
    assert np.mean(same) > 0.8
    assert np.median([speeds_m_s[t] for t in standing[4:] if t in speeds_m_s]) < 0.5


def test_it_moves_on_as_itself_though_others_pass():
    """It is not detected while it stands, but for its first second; another passes 4 m beside it."""
    design = track.TrackDesign().replace({"query.policy": "none", "reporting.max_false_share": 0.5})
    state, states = track.start(design), []
    area = track.Grid((100, 200), (-100.0, 75.0), 1.5)
    for k in range(40):
        t, places = 0.5 * k, []
        again = max(t - STOP_S - STAND_S, 0.0)
        if t < STOP_S + 1.0 or again > 1.0:
            places.append((travel(t) + again**2, 0.0))
        if 8.0 <= t <= 14.0:
            places.append((10.0 * (t - 8.0), 4.0))
        n = len(places)
        found = track.Detections(
            np.reshape(places, (n, 2)).astype(float), np.repeat(0.25 * np.eye(2)[None], n, 0), np.ones(n),
            np.ones(n), log_likelihood_ratio=np.full(n, 3.0),
        )  # fmt: skip
        state = track.step_detections(state, found, t, area)
        states.append(state)
    told = list(track.report_epochs(iter(states)))
    first = int(told[8]["track"][0])
    middle = told[22]
    assert str(middle.sel(track=first)["status"].values) == "stopped"
    assert abs(float(middle.sel(track=first)["east_m"]) - travel(STOP_S)) < 3.0
    last = told[-1].sel(track=first)
    assert abs(float(last["east_m"]) - travel(STOP_S) - (19.5 - STOP_S - STAND_S) ** 2) < 3.0
