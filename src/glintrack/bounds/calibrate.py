"""Maps of P_D and clutter of a case's detectors, and how its vehicles move, from flights of other seeds.

The city stays, for the maps are of its places; noise and the navigator's errors are drawn anew, and the
flights begin at other times of the traffic, one after the other behind the case's own where its recording is
long enough.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from glintrack import metrics
from glintrack.bounds.accuracy import fit_kinematics
from glintrack.bounds.flight_accuracy import Sighting, Turn, measured_detector, sighting, turn
from glintrack.bounds.maps import Chances, detection_maps, motion_angle
from glintrack.case.design import Case
from glintrack.loop import simulate
from glintrack.results.epoch import Epoch
from glintrack.scene import City, build_scene

SEEDS = (101, 102)


def other_flights(case: Case, seeds: tuple[int, ...], duration_s: float) -> list[Case]:
    """The case with other seeds, each at its own time of the traffic.

    Parameters
    ----------
    case, seeds
        The case, and the seeds of the flights; its own is none of them.
    duration_s
        How long the recorded traffic is, from the case's start. [s]

    Raises
    ------
    ValueError
        If there are no seeds, or the case's own is among them.
    """
    _check_seeds(case, seeds)
    length_s = case.flight.frames / case.flight.rate_hz
    latest_s = duration_s - (case.flight.frames - 1) / case.flight.rate_hz
    starts = [case.flight.start_s + (1 + k) * length_s for k in range(len(seeds))]
    return [
        case.replace({"seed": seed, "flight.start_s": start if start <= latest_s else case.flight.start_s})
        for seed, start in zip(seeds, starts, strict=True)
    ]


def calibrate(
    case: Case, seeds: tuple[int, ...] = SEEDS, progress: Callable[[int], None] | None = None
) -> dict[str, xr.Dataset]:
    """Fly other seeds and count: channel -> its maps.

    Parameters
    ----------
    case, seeds
        See `other_flights`.
    progress
        Called with the number of frames done.

    Returns
    -------
    `detection_maps` of each channel, with the attributes ``seeds``, the detector's P_D over visible movers
    and standard deviations, and the ``acceleration_psd_m2_s3`` and ``speed_sigma_m_s`` of the traffic.
    """
    _check_seeds(case, seeds)
    city = build_scene(case.scene)
    recorders = []
    for flown in other_flights(case, seeds, city.duration_s):
        recorder = _Recorder()
        recorders.append(recorder)
        before = (len(recorders) - 1) * case.flight.frames

        def see(epoch: Epoch, recorder=recorder, before=before) -> None:
            recorder.see(epoch)
            if progress is not None and epoch.channel == case.channels[-1]:
                progress(before + epoch.index + 1)

        simulate(flown, see)
    motion = fit_kinematics(*_steps(city, case))
    out = {}
    for channel in case.channels:
        chances = Chances.joined([c for recorder in recorders for c in recorder.chances[channel]])
        maps = detection_maps(chances, city.extent_m)
        sightings = [s for recorder in recorders for s in recorder.sightings]
        detector = measured_detector(
            sightings, [t for recorder in recorders for t in recorder.turns[channel]]
        )
        maps.attrs |= {
            "seeds": list(seeds),
            "acceleration_psd_m2_s3": motion.acceleration_psd,
            "speed_sigma_m_s": motion.speed_sigma,
            "crs": city.crs,
            "origin_m": [city.origin_easting_m, city.origin_northing_m],
        }
        if detector is not None:
            maps.attrs |= {"visible_detection_probability": detector.probability, **detector.sigmas()}
        out[channel] = maps
    return out


def _check_seeds(case: Case, seeds: tuple[int, ...]) -> None:
    if not seeds:
        raise ValueError("`seeds` must name one flight at least, got none")
    if case.seed in seeds:
        raise ValueError(f"`seeds` must differ from the case's own, got {case.seed} among {list(seeds)}")


@dataclass
class _Recorder:
    """What a flight's loops had to find and found."""

    sightings: list[Sighting] = field(default_factory=list)
    turns: dict[str, list[Turn]] = field(default_factory=dict)
    chances: dict[str, list[Chances]] = field(default_factory=dict)

    def see(self, epoch: Epoch) -> None:
        truth, area_m = epoch.true_frame.truth, epoch.city.extent_m
        if not self.sightings or self.sightings[-1].time_s != epoch.time_s:
            self.sightings.append(sighting(epoch.time_s, epoch.true_frame.true_pose, truth, area_m))
        seen, found = self.sightings[-1], epoch.detections.position
        made = turn(seen, found, epoch.tracks)
        self.turns.setdefault(epoch.channel, []).append(made)
        there = np.asarray(metrics.is_moving(truth) & metrics.is_in_window(truth, area_m))
        velocity = np.stack([truth["east_speed"].values, truth["north_speed"].values], axis=1)[there]
        place = seen.place[there]
        self.chances.setdefault(epoch.channel, []).append(
            Chances(
                place,
                np.hypot(*velocity.T),
                motion_angle(place, velocity, seen.lens_m),
                np.isin(seen.vehicle[there], made.found),
                made.false,
                1,
            )
        )


def _steps(city: City, case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intervals of a frame in which vehicles moved, outside the case's own flight if the traffic goes on."""
    step_s = 1 / case.flight.rate_hz
    own = case.flight.start_s, case.flight.start_s + case.flight.frames * step_s
    times = np.arange(0.0, city.duration_s - step_s, step_s)
    beyond = times[(times + step_s < own[0]) | (times > own[1])]
    spans, before, after = [], [], []
    known: dict[int, dict[int, tuple[float, float]]] = {}
    for k in np.rint((beyond if len(beyond) else times) / step_s).astype(int).tolist():
        known |= {n: _velocities(city.truth(n * step_s)) for n in (k, k + 1) if n not in known}
        first, second = known[k], known[k + 1]
        both = [i for i in first if i in second and np.hypot(*first[i]) >= metrics.MOVING_SPEED_M_S]
        spans += [step_s] * len(both)
        before += [first[i] for i in both]
        after += [second[i] for i in both]
    return np.array(spans), np.array(before).reshape(-1, 2), np.array(after).reshape(-1, 2)


def _velocities(truth: xr.Dataset) -> dict[int, tuple[float, float]]:
    speeds = zip(truth["east_speed"].values.tolist(), truth["north_speed"].values.tolist(), strict=True)
    return dict(zip(truth["vehicle"].values.tolist(), speeds, strict=True))
