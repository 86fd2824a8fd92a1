"""What the ladder adds to a flight, in processor time on one core.

``python benchmarks/ladder.py [CASE] [--frames N]``. Flies with the case's own loops and `bound.every`, and
times each measured frame's ladder apart from everything else. The first measured frame loads kernels and is
not counted; without a ladder a frame costs what is left. On every fourth measured frame
places are told too, which costs more: 26 frames hold one such.
"""

import argparse
import time

import numba
import numpy as np

from glintrack.bounds.run import FlightLadder
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.loop import simulate


def main() -> None:
    """Print what a frame and a measured frame cost, and their ratio."""
    parser = argparse.ArgumentParser(description="What the ladder adds to a flight")
    parser.add_argument("case", nargs="?", default="quickstart")
    parser.add_argument("--frames", type=int, default=26)
    asked = parser.parse_args()
    numba.set_num_threads(1)
    case = Case.from_toml(find_case(asked.case)).replace({"flight.frames": asked.frames})
    steps, every = FlightLadder(case), case.bound.every
    ladder, frame, last = [], [], [time.process_time()]

    def measure(epoch) -> None:
        frame[epoch.index :] = [sum(frame[epoch.index :]) + time.process_time() - last[0]]
        begun = time.process_time()
        steps.measure(epoch)
        ladder[epoch.index :] = [sum(ladder[epoch.index :]) + time.process_time() - begun]
        last[0] = time.process_time()

    simulate(case, measure)
    one = float(np.median(frame[every + 1 :]))
    measured = float(np.mean(ladder[2 * every :: every]))
    rest = float(np.median([cost for k, cost in enumerate(ladder) if k % every]))
    added = (measured - rest) / every + rest
    print(f"processor time: a frame without a ladder {one:.2f} s, a measured frame's ladder {measured:.2f} s")
    print(f"on every {every}th frame: {100 * added / one:.0f} % more")


if __name__ == "__main__":
    main()
