"""``glintrack score``: score any tracks against the truth."""

import json
import math
from pathlib import Path
from typing import Annotated

import numpy as np
import xarray as xr
from scipy.spatial import KDTree

from glintrack.cli.options import Area, Corner, argument, check_output, command_app, open_console, option
from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.io import atomic
from glintrack.io.detections import read_tracks, read_truth
from glintrack.io.orthoimages import Geotransform
from glintrack.metrics import MATCH_DISTANCE_M
from glintrack.results.run import score as score_files

app = command_app()

_M_PER_S = 1e6  # distance that one second counts as, so that no position is near one of another time
_MIN_PLAUSIBLE = 0.05  # completeness; below it a sentence asks whether both files have the same coordinates
_UNITS = {"_per_km2": "km⁻²", "_per_frame": "per frame", "_m": "m", "_s": "s"}


def _text(value: float) -> str:
    return "–" if value != value else f"{value:.4g}"


def _coordinate_hint(tracks: xr.Dataset, truth: xr.Dataset) -> str:
    """Sentence on how tracks and vehicles could be in different coordinates; empty if they are not."""
    place, vehicle = (np.stack([of["east_m"].values, of["north_m"].values], axis=1) for of in (tracks, truth))
    low, high = vehicle.min(axis=0), vehicle.max(axis=0)
    room = 0.1 * (high - low) + 10.0
    tree = KDTree(np.column_stack([_M_PER_S * truth["time_s"].values, vehicle]))

    def lies_within(other: np.ndarray) -> bool:
        return bool((((other > low - room) & (other < high + room)).all(axis=1)).mean() > 0.9)

    def lies_at_vehicles(other: np.ndarray) -> bool:
        placed = np.column_stack([_M_PER_S * tracks["time_s"].values, other])
        return bool(np.isfinite(tree.query(placed, distance_upper_bound=MATCH_DISTANCE_M)[0]).mean() > 0.5)

    remedies = {
        "are east and north exchanged?": place[:, ::-1],
        "are they in km?": 1000 * place,
        "does north run downward?": place * [1, -1],
    }
    remedy = ""
    for fits in (lies_at_vehicles, lies_within):  # exchanged coordinates may lie within a square window too
        if fits(place):
            return ""
        if remedy := next((text for text, changed in remedies.items() if fits(changed)), ""):
            break
    spans = [
        f"{name} {at[:, 0].min():.4g} to {at[:, 0].max():.4g} m east, "
        f"{at[:, 1].min():.4g} to {at[:, 1].max():.4g} m north"
        for name, at in (("tracks lie", place), ("vehicles", vehicle))
    ]
    remedy = remedy or "are both in the same coordinates, in m?"
    return f"hardly a track is a vehicle's: {'; '.join(spans)} ({remedy})"


@app.command()
def score(
    tracks: Annotated[Path, argument("Tracks, CSV: time_s, track_id, east_m, north_m, …; or MOT .txt")],
    truth: Annotated[Path, argument("Truth, CSV: time_s, vehicle_id, east_m, north_m, …; or MOT .txt")],
    area: Annotated[Area | None, option("West, south, east, north of the scored area [m]")] = None,
    match_m: Annotated[float, option("Matching distance [m]", "--match-m", min=0.01)] = MATCH_DISTANCE_M,
    moving_m_s: Annotated[
        float, option("Smallest speed to be tracked [m/s]", "--moving-m-s", min=0)
    ] = MOVING_SPEED_M_S,
    rate_hz: Annotated[float | None, option("Frame rate of MOT .txt [Hz]", "--rate")] = None,
    geotransform: Annotated[Corner | None, option("West and north edge, pixel size of MOT .txt [m]")] = None,
    output: Annotated[Path | None, option("JSON file to write the scores to", "--json")] = None,
) -> None:
    """Score tracks against the truth: completeness and purity (Eqs. 13 and 14), and more."""
    if output is not None:
        check_output(output, ".json", option="json")
    grid = None if geotransform is None else Geotransform(*geotransform)
    if ".txt" not in (tracks.suffix, truth.suffix) and (rate_hz or grid):
        raise ValueError("`rate` and `geotransform` must be used with MOT .txt; got two files with times.")
    rows, known = read_tracks(tracks, rate_hz, grid), read_truth(truth, rate_hz, grid)
    scores = score_files(rows, known, area, match_m, moving_m_s)
    console = open_console()
    if scores["completeness"] <= _MIN_PLAUSIBLE and rows.sizes.get("row"):  # NaN if no vehicle moves
        if hint := _coordinate_hint(rows, known):
            console.print(hint, style="yellow")
    around = "the truth that is `inside`" if "inside" in known and known["inside"].any() else "the truth"
    where = "the area given" if area is not None else f"the box around {around} (--area gives another)"
    share = f"no vehicle in {where} is as fast as --moving-m-s: none should be tracked"
    if not math.isnan(tracked := scores["completeness"]):
        share = f"a share of {_text(tracked)} of the moving vehicles is tracked"
    console.print(
        f"{share}; track purity is {_text(scores['purity'])}; there are {_text(scores['false_per_frame'])} "
        f"false tracks per frame; areas are of {where}"
    )
    for name, value in scores.items():
        unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
        console.print(f"{name:22s} {_text(value):>9s} {unit}".rstrip())
    if output is not None:
        finite = {name: None if value != value else value for name, value in scores.items()}
        atomic.write_text(output, json.dumps(finite, indent=1) + "\n")
        console.print(f"wrote {output}")
