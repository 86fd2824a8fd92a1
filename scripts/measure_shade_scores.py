"""Completeness of visible moving vehicles in the sun and in the shade, by channel, over flights of cases.

    python scripts/measure_shade_scores.py [--flights quickstart:1 braunschweig:1] [--frames 30]

A vehicle stands in the shade if at most a quarter of what is seen of its upward faces is lit, in the sun
if three quarters are; between is half shade. Those without an upward face in view, and frames before the
tracker has settled (``--settled``), do not count. An interval is two standard errors, by blocks of five
frames.
"""

import argparse

import numpy as np

from glintrack import simulate
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.render import Hits

UPWARD = 0.7  # component of the normal from which a face looks up
SHADE, SUN = 0.25, 0.75
STANDS = ("in the sun", "in half shade", "in the shade")
BLOCK = 5  # frames


def lit_part(hits: Hits, ids: np.ndarray) -> np.ndarray:
    """Part of each vehicle's upward faces in view that the sun lights; NaN if none is in view. [1]"""
    up = (hits.vehicle_id >= 0) & (hits.normal[:, 2] > UPWARD)
    of, weight, light = hits.vehicle_id[up], hits.weight[up], hits.sun_visible[up]
    count = int(max(of.max(initial=0), ids.max(initial=0))) + 1
    whole, lit = (np.bincount(of, w, minlength=count)[ids] for w in (weight, weight * light))
    return np.divide(lit, whole, out=np.full(len(ids), np.nan), where=whole > 0)


def stand_of(lit: np.ndarray) -> np.ndarray:
    """Index into `STANDS`; −1 where it is not known."""
    where = np.where(lit >= SUN, 0, np.where(lit > SHADE, 1, 2))
    return np.where(np.isnan(lit), -1, where)


def fly(name: str, seed: int, frames: int, settled: int) -> dict[str, np.ndarray]:
    """For each channel (frame, stand, 2): visible moving vehicles, and those of them that are tracked."""
    case = Case.from_toml(find_case(name)).replace(
        {"seed": seed, "flight.frames": frames, "bound.every": 0, "output.film_frames": 0}
    )
    counts: dict[str, list[np.ndarray]] = {}

    def take(epoch) -> None:
        if epoch.index < settled:
            return
        score = epoch.score
        ids = score.vehicle_ids[score.visible]
        stand = stand_of(lit_part(epoch.hits, ids))
        tracked = score.matched_track[score.visible] >= 0
        rows = [[(stand == k).sum(), (tracked & (stand == k)).sum()] for k in range(len(STANDS))]
        counts.setdefault(epoch.channel, []).append(np.array(rows))

    simulate(case, take)
    return {channel: np.stack(rows) for channel, rows in counts.items()}


def share(counts: np.ndarray) -> tuple[float, float]:
    """Tracked over visible of (frame, 2) counts, and two standard errors by blocks of frames."""
    visible, tracked = counts.sum(axis=0)
    if visible == 0:
        return float("nan"), float("nan")
    blocks = np.array([b.sum(axis=0) for b in np.array_split(counts, max(len(counts) // BLOCK, 1))])
    wrong = blocks[:, 1] - tracked / visible * blocks[:, 0]
    spread = np.sqrt((wrong**2).sum() * len(blocks) / max(len(blocks) - 1, 1)) / visible
    return float(tracked / visible), float(2 * spread)


def main() -> None:
    """Fly and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", nargs="*", default=["quickstart:1", "braunschweig:1"])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--settled", type=int, default=10, help="frames left out before")
    given = parser.parse_args()
    print(f"| flight | channel | {' | '.join(STANDS)} |\n| --- | --- |{' --- |' * len(STANDS)}")
    for flight in given.flights:
        name, seed = flight.split(":")
        for channel, counts in fly(name, int(seed), given.frames, given.settled).items():
            cells = []
            for k in range(len(STANDS)):
                part, wrong = share(counts[:, k])
                cells.append(f"{part:.3f} ± {wrong:.3f} ({counts[:, k, 0].sum()})")
            print(f"| {flight} | {channel} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
