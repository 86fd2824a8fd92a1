"""``glintrack score``: scores of anybody's tracks."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
import xarray as xr
from rich.console import Console
from scipy.spatial import KDTree

from glintrack.cli.options import command_app
from glintrack.io import atomic
from glintrack.io.detections import read_tracks, read_truth
from glintrack.results.run import score as score_files

app = command_app()

MATCH_DISTANCE_M, MOVING_SPEED_M_S = 5.0, 1.0  # as `metrics` has them, which takes seconds to load
_APART_M_S = 1e6  # what a second counts, so that no place is near one of another time
_HARDLY = 0.05  # of the vehicles held: less asks whether both files mean the same places
_UNITS = {"_per_km2": "km⁻²", "_per_epoch": "an epoch", "_m": "m", "_s": "s"}


def _text(value: float) -> str:
    return "–" if value != value else f"{value:.4g}"


def _elsewhere(tracks: xr.Dataset, truth: xr.Dataset) -> str:
    """What would bring tracks and vehicles together, and where they lie; nothing if they do not lie apart."""
    place, wanted = (np.stack([of["east"].values, of["north"].values], axis=1) for of in (tracks, truth))
    low, high = wanted.min(axis=0), wanted.max(axis=0)
    room = 0.1 * (high - low) + 10.0
    at_its_time = KDTree(np.column_stack([_APART_M_S * truth["time_s"].values, wanted]))

    def fits(other: np.ndarray) -> bool:
        return bool((((other > low - room) & (other < high + room)).all(axis=1)).mean() > 0.9)

    def meets(other: np.ndarray) -> bool:
        placed = np.column_stack([_APART_M_S * tracks["time_s"].values, other])
        return bool(
            np.isfinite(at_its_time.query(placed, distance_upper_bound=MATCH_DISTANCE_M)[0]).mean() > 0.5
        )

    remedies = {
        "are east and north exchanged?": place[:, ::-1],
        "are they in km?": 1000 * place,
        "does north run downward?": place * [1, -1],
    }
    for holds in (meets, fits):  # a window as wide as it is high holds exchanged places too
        if holds(place):
            return ""
        if remedy := next((words for words, changed in remedies.items() if holds(changed)), ""):
            break
    told = [f"{name} {_span(p[:, 0])} m east, {_span(p[:, 1])} m north" for name, p in
            (("tracks lie", place), ("vehicles", wanted))]  # fmt: skip
    remedy = remedy or "are both in the same coordinates, in m?"
    return f"hardly a track is a vehicle's: {'; '.join(told)} ({remedy})"


def _area_words(truth: xr.Dataset, given: bool) -> str:
    around = "the truth that is `inside`" if "inside" in truth else "the truth"
    return "the area given" if given else f"the box around {around} (--area gives another)"


def _span(values: np.ndarray) -> str:
    return f"{values.min():.4g} to {values.max():.4g}"


@app.command()
def score(
    tracks: Annotated[Path, typer.Argument(help="tracks.csv: time_s, track_id, east_m, north_m, …")],
    truth: Annotated[Path, typer.Argument(help="truth.csv: time_s, vehicle_id, east_m, north_m, …")],
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="West, south, east, north of the area whose vehicles count [m]"),
    ] = None,
    match_m: Annotated[
        float, typer.Option("--match-m", help="A track farther from a vehicle is not its track [m]")
    ] = MATCH_DISTANCE_M,
    moving_m_s: Annotated[
        float, typer.Option("--moving-m-s", help="A vehicle at least this fast should be tracked [m/s]")
    ] = MOVING_SPEED_M_S,
    output: Annotated[Path | None, typer.Option("--json", help="Write the scores to this file")] = None,
) -> None:
    """Score tracks against the truth: completeness and purity (Eqs. 13 and 14), and more."""
    if not match_m > 0:
        raise ValueError(f"`match-m` must be greater than 0 m, got {match_m:g}")
    if not moving_m_s >= 0:
        raise ValueError(f"`moving-m-s` must be 0 m/s or more, got {moving_m_s:g}")
    if output is not None and output.suffix.lower() != ".json":
        raise ValueError(f"`json` must end in .json, got {output.name!r}")
    if output is not None and not output.absolute().parent.is_dir():
        raise ValueError(f"`json` must lie in a folder that exists, got {output}")
    rows, known = read_tracks(tracks), read_truth(truth)
    scores = score_files(rows, known, area, match_m, moving_m_s)
    console = Console()
    if scores["completeness"] <= _HARDLY and rows.sizes.get("row"):  # NaN where no vehicle is to be held
        said = _elsewhere(rows, known)
        if said:
            console.print(said, style="yellow", soft_wrap=True, highlight=False)
    held, false = scores["completeness"], scores["false_per_epoch"]
    share = (
        f"no vehicle in {_area_words(known, area is not None)} is as fast as --moving-m-s: none is to be held"
    )
    if held == held:
        share = f"a share of {_text(held)} of the moving vehicles is held"
    console.print(
        f"{share}, the tracks' purity is {_text(scores['purity'])}, {_text(false)} tracks are false "
        f"an epoch; areas are of {_area_words(known, area is not None)}",
        soft_wrap=True,
        highlight=False,
    )
    for name, value in scores.items():
        unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
        console.print(f"{name:22s} {_text(value):>9s} {unit}".rstrip(), highlight=False)
    if output is not None:
        atomic.write_text(
            output, json.dumps({k: None if v != v else v for k, v in scores.items()}, indent=1) + "\n"
        )
        console.print(f"wrote {output}", soft_wrap=True)
