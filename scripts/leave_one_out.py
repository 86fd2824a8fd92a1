"""What each part of the detector `mosaic` and of the tracker behind it is worth: the same flight without it.

``python scripts/leave_one_out.py [--flight embedded:51] [--channel all]`` flies (`scripts/record_flight.py`)
and prints two tables:

- of single frames the probability of detection, as `scripts/measure_background.py` has it, each row by a law
  fitted to itself;
- of tracks, from frame 10 on, scores of the packaged case's tracker on the same detections, by its own laws.
"""

import argparse
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from unittest.mock import patch

import numpy as np
from calibrate_belief import Flight, detected
from compare_detectors import settled
from measure_background import measured
from record_flight import recorded

from glintrack.track import companions, late, renewal
from glintrack.track.design import NEVER_DOUBTED
from glintrack.track.detect import mosaic, mosaic_model, mosaic_noise, mosaic_start
from glintrack.track.detect.footprint import footprints

NEVER = 1e9
OVER_FRAMES = ("√support", "still", "√still")
# name, what is patched, which features the law lacks
DETECTOR = (
    ("as it is", (), ()),
    ("frames registered", (patch.object(mosaic_model, "_shift", lambda *_: np.zeros(2)),), ()),
    ("scale of each place", (patch.object(mosaic_noise, "follow_scale", lambda *_: None),), ()),
    ("the fit's spread in it", (patch.object(mosaic_model, "PARTS", np.array([0.8, 0.0, 0.5])),), ()),
    ("what differs learnt less", (patch.object(mosaic_model, "SOFT", NEVER),), ()),
    ("likely vehicles masked", (patch.object(mosaic, "MASK_RATIO", NEVER),), ()),
    ("first frames made to agree", (patch.object(mosaic_start, "FRAMES", int(NEVER)),), ()),
    ("six directions", (patch.object(mosaic, "footprints", lambda *size: footprints(*size, 1)),), ()),
    ("evidence over frames", (), OVER_FRAMES),
    ("standstill against it", (), ("still", "√still")),
    ("how restless the place is", (), ("restless", "√restless")),
)
# name, keys of the tracker's initiation, what is patched, what detections lack
TRACKER = (
    ("as it is", {}, (), {}),
    ("told 1.5 s late", {"report_lag_s": 0.0}, (), {}),
    ("reported by belief", {"report_false_share": NEVER_DOUBTED}, (), {}),
    ("led back before the first", {}, (patch.object(late, "BACK_S", 0.0),), {}),
    ("pairs reported as one", {}, (patch.object(companions, "leaders", lambda _, t: np.arange(len(t))),), {}),
    ("renamed where found far", {}, (patch.object(renewal, "FAR_M", NEVER),), {}),
    ("speeds of detections", {}, (), {"velocity": None}),
    ("likelihood ratios, and belief", {}, (), {"log_likelihood_ratio": None}),
)


def tracked(flight: Flight, keys: Mapping[str, float], lacking: Mapping[str, None]) -> Mapping[str, float]:
    """Scores of the tracker on a flight's detections."""
    poorer = [(t, replace(found, **lacking), grid, truth) for t, found, grid, truth in flight.found]
    states = replace(flight, found=poorer).states(**keys)
    return settled(states, [truth for *_, truth in flight.found], flight.extent_m)


def main() -> None:
    """Fly, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flight", default="embedded:51", help="CASE:SEED")
    parser.add_argument("--channel", default="all", choices=("pan", "dolp", "all"))
    args = parser.parse_args()
    recording = recorded(args.flight)
    print("| detector without | P_D at 20 false a frame | at 40 | another within 10 m | none within 15 m |")
    print("|" + " --- |" * 5)
    for name, patches, without in DETECTOR:
        with _all(patches):
            found = measured(recording, args.channel, without=without)
        print(f"| {name} | " + " | ".join(f"{p:.3f}" for p in found) + " |", flush=True)
    print("\n| tracker without | of visible | purity | custody | false per km² | switches |")
    print("|" + " --- |" * 6)
    flight = detected(recording, args.channel)
    for name, keys, patches, lacking in TRACKER:
        with _all(patches):
            of = tracked(flight, keys, lacking)
        shares = " | ".join(f"{of[k]:.3f}" for k in ("completeness_visible", "purity", "custody"))
        print(
            f"| {name} | {shares} | {of['false_per_km2']:.1f} | {of['identity_switches']:.0f} |", flush=True
        )


def _all(patches) -> ExitStack:
    stack = ExitStack()
    for one in patches:
        stack.enter_context(one)
    return stack


if __name__ == "__main__":
    main()
