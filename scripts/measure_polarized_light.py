"""What polarized light says of vehicles that its intensity does not: bands, hours and views, by the ladder.

``python scripts/measure_polarized_light.py [--seeds 51] [--csv FILE]`` flies 6 s of each through half the
array's sides, without a tracker, and measures three frames: how far the visible moving vehicles stand out of
noise (d′) in the mirrors, in DoLP and in all four elements, and how many are found at as many false ones,
each with the light as it is and with S1 = S2 = 0. A seed is a city with its paints. It prints a line for each
view and band: median d′ and the one that 95 % exceed, and by how much polarization changes them and what is
found. Rows that are in FILE are kept and not flown again; a row takes 45 s of processor time.
"""

import argparse
import itertools
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd

from glintrack.bounds import run
from glintrack.bounds.ladder import ladder
from glintrack.case.design import Case
from glintrack.case.packaged import find_case

BANDS = {  # µm, and an exposure in which sunlight fills the elements about as far as the packaged case's [ms]
    "0.40–1.00": ((0.40, 1.00), 0.085),
    "0.45–0.50": ((0.45, 0.50), 0.9),
    "0.80–0.90": ((0.80, 0.90), 0.6),
    "1.50–1.75": ((1.50, 1.75), 0.48),
    "2.05–2.35": ((2.05, 2.35), 0.88),
}
VIEWS = {  # from the sun's azimuth, and hour
    "toward the sun": (0.0, 15.0),
    "across": (90.0, 15.0),
    "away from the sun": (180.0, 15.0),
    "toward the sun, 5 PM": (0.0, 17.0),
}
RUNGS = "known_background", "predicted_background"


def solved(limits: tuple[float, float]) -> dict[str, object]:
    """An atmosphere of the band alone beyond the packaged one's wavelengths."""
    if limits[1] <= 1.0:
        return {}
    return {
        "atmosphere.wavelength_start_um": limits[0],
        "atmosphere.wavelength_stop_um": limits[1],
        "atmosphere.altitudes_m": (500.0, 2000.0, 3000.0),
        "sensor.spectrometer_um": limits,
    }


def design(seed: int, view: str, band: str) -> Case:
    """Half the array's sides over a city of its own."""
    azimuth, hour = VIEWS[view]
    limits, exposure = BANDS[band]
    changes = {
        "seed": seed,
        "scene.seed": seed,
        "sensor.rows": 280,
        "sensor.columns": 440,
        "flight.frames": 13,
        "bound.every": 4,
        "flight.azimuth_from_sun_deg": azimuth,
        "atmosphere.local_time_h": hour,
        "sensor.band_um": limits,
        "sensor.integration_time_ms": exposure,
        **solved(limits),
    }
    return Case.from_toml(find_case("quickstart")).replace(changes)


def measured(case: Case) -> dict[str, float]:
    """d′ and shares of the visible movers, by group and light."""
    kept, recorders = run._ladders, []

    def keeping(recorder, *rest):
        recorders.append(recorder)
        return kept(recorder, *rest)

    with patch.object(run, "_ladders", keeping):
        run.measure_bounds(case)
    recorder, row = recorders[0], {}
    for light, groups in (("", recorder.frames), ("bare_", recorder.unpolarized)):
        for group, frames in groups.items():
            found = ladder(frames, case.bound.false_per_frame)
            told = np.concatenate([f.detectability for f in frames])
            row["vehicles"] = len(told)
            row |= {f"{light}{group}_d5": np.quantile(told, 0.05), f"{light}{group}_d50": np.median(told)}
            row |= {f"{light}{group}_{rung}": float(found["of_visible"].sel(rung=rung)) for rung in RUNGS}
    return row


def print_table(rows: pd.DataFrame) -> None:
    """Means over the seeds, and how much larger they are than without polarization."""
    columns = ["mirrors d′", "DoLP d′", "all d′", "all d′, 5 %"]
    print("| view | band [µm] | " + " | ".join(columns) + " | found: known background | predicted |")
    print("|" + " --- |" * (len(columns) + 4))
    mean = rows.groupby(["view", "band"], sort=False).mean(numeric_only=True)
    for (view, band), one in mean.iterrows():
        cells = [f"{one['pan_d50']:.0f}"]
        for name in ("dolp_d50", "all_d50", "all_d5"):
            cells.append(f"{one[name]:.0f} ({100 * (one[name] / one[f'bare_{name}'] - 1):+.1f} %)")
        cells += [f"{one[f'all_{r}']:.3f} ({one[f'all_{r}'] - one[f'bare_all_{r}']:+.3f})" for r in RUNGS]
        print(f"| {view} | {band} | " + " | ".join(cells) + " |")
    for rung in RUNGS:
        gain = (rows[f"all_{rung}"] - rows[f"bare_all_{rung}"]).mean()
        print(f"{rung}: {gain:+.4f} in the mean of {len(rows)} rows")  # of the same vehicles: no interval


def main() -> None:
    """Fly, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[51])
    parser.add_argument("--csv", type=Path, help="keep the rows here")
    chosen = parser.parse_args()
    rows = pd.read_csv(chosen.csv).to_dict("records") if chosen.csv and chosen.csv.exists() else []
    done = {(r["seed"], r["view"], r["band"]) for r in rows}
    for seed, view, band in itertools.product(chosen.seeds, VIEWS, BANDS):
        if (seed, view, band) not in done:
            rows.append({"seed": seed, "view": view, "band": band} | measured(design(seed, view, band)))
            if chosen.csv:
                pd.DataFrame(rows).to_csv(chosen.csv, index=False)
    print_table(pd.DataFrame(rows))


if __name__ == "__main__":
    main()
