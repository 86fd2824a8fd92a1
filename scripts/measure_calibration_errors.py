"""What errors of a micropolarizer array's calibration do to DoLP and the ladder, beside those of pose.

    python scripts/measure_calibration_errors.py [--frames 11] [--rows 280] [--columns 440]

Flies the quickstart over a part of its window (a quarter by default), each frame traced once for all rows of
the table. Each row has one error; what it does to DoLP is the RMS difference of the rectified frames' DoLP
from those without errors, over the same light and noise. The ladder's rungs are shares of the visible movers
on every fifth frame (docs/bounds.md); so few vehicles are in a part of the window that a share is uncertain
by about one over their number, which stands below the table.
"""

import argparse

import numpy as np

from glintrack import Case, simulate
from glintrack.bounds.run import FlightLadder
from glintrack.case.packaged import find_case

# name of the row -> keys of the case
ERRORS = {
    "none": {},
    "gain, 1 % RMS": {"sensor.polarizer_spread.gain": 0.01},
    "diattenuation, 5 % RMS": {"sensor.polarizer_spread.diattenuation": 0.05},
    "angle, 1° RMS": {"sensor.polarizer_spread.angle_deg": 1.0},
    "offset, 500 e RMS": {"sensor.polarizer_spread.offset_e": 500.0},
    "all four": {
        "sensor.polarizer_spread.gain": 0.01,
        "sensor.polarizer_spread.diattenuation": 0.05,
        "sensor.polarizer_spread.angle_deg": 1.0,
        "sensor.polarizer_spread.offset_e": 500.0,
    },
    "extinction 30 taken for ideal": {
        "sensor.polarizer": "constant",
        "sensor.polarizer_extinction_ratio": 30.0,
        "sensor.stokes": "fesenkov",
    },
    "pose of class POS AV 510": {"navigation.preset": "pos-av-510"},
    "pose jitter, 0.005°": {"navigation.preset": "jitter"},
    "surface model known": {"ortho.surface": "surface"},
}
RUNGS = ("known_background", "predicted_background", "reported_pose", "detector")


class KeptHits(dict):
    """Traced frames by their time: none of these errors touches them."""

    def get(self, time_s, observe):
        """The kept frame, or what is traced now."""
        if time_s not in self:
            self[time_s] = observe()
        return self[time_s]


def fly(case, kept):
    """DoLP of every rectified frame, and the ladders of DoLP and of all elements."""
    ladder, pictures = FlightLadder(case), {}

    def watch(epoch):
        ladder.measure(epoch)
        if epoch.channel == "dolp":
            pictures[epoch.time_s] = epoch.image["dolp"].values.astype(np.float32)

    tree = simulate(case, watch, kept)
    return pictures, ladder.ladders(tree)


def rms_between(these, those):
    """RMS difference of DoLP over all cells that both have. [1]"""
    squares = [((these[t] - those[t]) ** 2) for t in those]
    return float(np.sqrt(np.nanmean(np.stack(squares))))


def main():
    """Print the table, row by row."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--frames", type=int, default=11)
    options.add_argument("--rows", type=int, default=280)
    options.add_argument("--columns", type=int, default=440)
    given = options.parse_args()
    base = Case.from_toml(find_case("quickstart")).replace(
        {
            "channels": ("dolp", "all"),
            "flight.frames": given.frames,
            "sensor.rows": given.rows,
            "sensor.columns": given.columns,
            "bound.every": 5,
        }
    )
    kept, plain = KeptHits(), {}
    print("| error | RMS DoLP | " + " | ".join(f"{r}, DoLP / all" for r in RUNGS) + " |")
    print("| --- | --- |" + " --- |" * len(RUNGS))
    for name, keys in ERRORS.items():
        pictures, ladders = fly(base.replace(keys), kept)
        plain = plain or pictures
        shares = [
            " / ".join(f"{float(ladders[g]['of_visible'].sel(rung=rung)):.2f}" for g in ("dolp", "all"))
            for rung in RUNGS
        ]
        print(f"| {name} | {rms_between(pictures, plain):.4f} | {' | '.join(shares)} |", flush=True)
    rows = ladders["dolp"].sizes.get("row", 0)
    print(
        f"\n{rows} visible vehicles and frames; {given.columns} × {given.rows} elements, "
        f"{given.frames} frames"
    )


if __name__ == "__main__":
    main()
