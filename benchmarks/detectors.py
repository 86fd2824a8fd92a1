"""Classical change detectors and ours on the same flights, each followed by SORT, GNN and `mht`.

``python benchmarks/detectors.py [--tune] [--flights embedded:51 braunschweig:31] [--json FILE]``. Flights
are flown once (`scripts/record_flight.py`) and all detectors see the same frames, panchromatic and with
reported poses: `mosaic` the raw mosaics, all others what is rectified of them. Tracks of `mosaic` are told
late, as the packaged cases have it. Differencing, the median and GoDec have our registration and windows;
their thresholds, and the least likelihood ratio with which a detection of `mosaic` counts in F1, have the
best F1 of frames on quickstart:11 (``--tune`` prints them). Detections do not depend on what is tracked. F1
is of single frames: moving vehicles, a quarter of which can be seen, that are found, and detections with no
vehicle near. ``value`` is the detector's processor time a frame.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from near_nadir import Plain, difference, from_median, godec
from tracking import sort_style, tracks_of

from glintrack import metrics, track
from glintrack.bounds.found import score_detections
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.track.detect.frame import grid_of
from glintrack.track.files import as_rows

sys.path.append(str(Path(__file__).parents[1] / "scripts"))
from record_flight import Recording, recorded

Found = list[track.Detections]

PLAIN = {"differencing": difference, "median": from_median, "GoDec": godec}
THRESHOLD = {"differencing": 6.0, "median": 5.0, "GoDec": 5.0}
OURS = ("mog2", "three-frame", "background", "mosaic")
TRIED = (4.0, 5.0, 6.0, 7.0)
LIKELY_NAT, TRIED_NAT = -1.0, (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0)  # of `mosaic`, which tells weak ones too
SCORES = ("completeness_visible", "purity", "custody", "false_per_km2", "mota", "hota")


def detections_of(recording: Recording, detector: track.Detector) -> tuple[Found, float]:
    """What a detector finds in each frame with nothing tracked, and its processor time a frame. [s]"""
    state, last_s, out, began = None, None, [], time.process_time()
    for frame in recording.seen():
        interval_s = 0.0 if last_s is None else frame.time_s - last_s
        frame = replace(frame, grid=grid_of(frame, None), interval_s=interval_s, channel="pan")
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        nobody = track.Association(np.zeros(len(found), bool), np.empty((0, 2)))
        state, last_s = detector.update(state, frame, found, nobody), frame.time_s
        out.append(replace(found, detail=None))
    return out, (time.process_time() - began) / len(out)


def f1(recording: Recording, found: Found, least_nat: float = LIKELY_NAT) -> float:
    """Of all frames together; of detections with a likelihood ratio of those that reach the least."""
    right = wrong = asked = 0
    for one, truth in zip(found, recording.truths, strict=True):
        ratio = one.log_likelihood_ratio
        kept = np.ones(len(one), bool) if ratio is None else ratio >= least_nat
        wanted = metrics.is_moving(truth) & metrics.is_in_window(truth, recording.extent_m)
        wanted &= metrics.is_visible(truth)
        place = np.stack([truth["east"].values, truth["north"].values], axis=1)
        scored = score_detections(one.position[kept], one.contrast[kept], place, truth["length"].values)
        right += int((np.isfinite(scored.vehicle) & wanted).sum())
        wrong, asked = wrong + len(scored.false), asked + int(wanted.sum())
    return 2 * right / max(right + wrong + asked, 1)


def reports_of(recording: Recording, found: Found, tracker: str, design: track.TrackDesign) -> xr.Dataset:
    """Rows of the tracks that a tracker makes of detections."""
    times = [frame.time_s for frame in recording.seen()]
    if tracker == "SORT":
        nobody = np.empty((0, 5))
        reports, _ = sort_style([(t, nobody, nobody) for t in times], [one.position for one in found])
        return as_rows(zip(times, (tracks_of(*report) for report in reports), strict=True))
    state = track.start(design.replace({"association.method": tracker, "query.policy": "none"}))
    grid, flown = grid_of(next(recording.seen()), None), []
    for time_s, one in zip(times, found, strict=True):
        state = track.step_detections(state, one, time_s, grid)
        flown.append(state)
    return as_rows(zip(times, track.told_of(flown), strict=True))


def truth_rows(recording: Recording) -> xr.Dataset:
    """The truth with one row a vehicle and frame."""
    parts = []
    for frame, truth in zip(recording.seen(), recording.truths, strict=True):
        table = truth.to_dataframe().reset_index().rename(columns={"vehicle": "vehicle_id"})
        parts.append(table.assign(time_s=frame.time_s))
    columns = {name: np.concatenate([part[name].to_numpy() for part in parts]) for name in parts[0]}
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def rows_of(recording: Recording, flight: str) -> Iterator[dict]:
    """Every detector with every tracker over one flight."""
    truth, packaged = truth_rows(recording), Case.from_toml(find_case(recording.case.name)).track
    for name in (*PLAIN, *OURS):
        detector = Plain(PLAIN[name], THRESHOLD[name]) if name in PLAIN else None
        detector = detector or track.DETECTORS[name](track.TrackDesign().detect)
        found, seconds = detections_of(recording, detector)
        design = packaged if name == "mosaic" else track.TrackDesign()
        for tracker in ("SORT", "gnn", "mht"):
            tracks = reports_of(recording, found, tracker, design)
            scores = metrics.score_rows(tracks, truth, recording.extent_m)
            yield {
                "flight": flight, "name": f"{name}, {tracker}", "f1": f1(recording, found),
                **{key: scores[key] for key in SCORES}, "value": seconds, "unit": "s",
            }  # fmt: skip


def main() -> None:
    """Fly, detect, track, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tune", action="store_true", help="print F1 of frames over thresholds")
    parser.add_argument("--flights", nargs="+", default=["embedded:51", "braunschweig:31"], help="NAME:SEED")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    if arguments.tune:
        recording = recorded("quickstart:11")
        for name, change in PLAIN.items():
            for threshold in TRIED:
                found, _ = detections_of(recording, Plain(change, threshold))
                print(f"{name:14}{threshold:6.2f}{f1(recording, found):8.3f}", flush=True)
        found, _ = detections_of(recording, track.DETECTORS["mosaic"](track.TrackDesign().detect))
        for least_nat in TRIED_NAT:
            print(f"{'mosaic':14}{least_nat:6.2f}{f1(recording, found, least_nat):8.3f}", flush=True)
        return
    rows = []
    for flight in arguments.flights:
        for row in rows_of(recorded(flight), flight):
            rows.append(row)
            keys = ("f1", *SCORES, "value")
            print(f"{flight:16}{row['name']:20}", *(f"{row[key]:7.3f}" for key in keys), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
