"""From the sensor's limit to the tracker's score, rung by rung, over the same vehicles (docs/bounds.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from glintrack.bounds.found import Scored, threshold
from glintrack.core.arrays import Array

RUNG_WORDS: Mapping[str, str] = {
    "moving": "moving in the window",
    "in_view": "in the frame",
    "visible": "visible",
    "ideal_observer": "noise alone",
    "known_background": "background known",
    "predicted_background": "predicted from past frames",
    "reported_pose": "with reported poses",
    "detector": "detector in use",
    "oracle_association": "joined by truth",
    "tracker": "tracker",
}
RUNGS = tuple(RUNG_WORDS)
FOUND = ("known_background", "predicted_background", "reported_pose", "detector")
TRACKED = ("oracle_association", "tracker")


@dataclass
class FrameLadder:
    """What one frame says of one group of elements.

    Parameters
    ----------
    index, time_s
        Which frame, and when. [1, s]
    movers, in_view
        How many vehicles move in the window, and of how many the frame holds the middle or sees enough.
    vehicles
        Of the visible movers: ``vehicle_id`` and what they are (``length``, ``speed``, …), a row each.
    probability, detectability
        The ideal observer's P_D and d′ of each. [1]
    information
        Fisher information of the (east, north) of each (`bound.position`). [m⁻²]
    scored
        By rung of `FOUND`: best score of each, and those of the false detections.
    held
        By rung of `TRACKED`: whether each is held.
    """

    index: int
    time_s: float
    movers: int
    in_view: int
    vehicles: dict[str, Array]
    probability: Array
    detectability: Array
    information: Array
    scored: dict[str, Scored] = field(default_factory=dict)
    held: dict[str, Array] = field(default_factory=dict)


def order_observers(of_group: Mapping[str, FrameLadder]) -> None:
    """Hold all elements to no less than pan and DoLP to no more: they know all that either does.

    Each observer's P_D is an approximation, which in much noise puts them in another order.
    """
    every, dolp = of_group["all"], of_group["dolp"]
    pan = of_group.get("pan", every)  # which light without polarization does not change
    for name in ("probability", "detectability"):
        most = np.maximum(getattr(every, name), getattr(pan, name))
        setattr(every, name, most)
        setattr(dolp, name, np.minimum(getattr(dolp, name), most))


def ladder(frames: list[FrameLadder], false_per_frame: float) -> xr.Dataset:
    """Every rung over all frames, at the same number of false detections.

    Returns
    -------
    ``ladder(rung)`` over the moving vehicles of the window, counting the visible ones alone from ``visible``
    on; ``of_visible(rung)`` over these; ``false_detections(rung)`` a frame, where the rung detects; NaN where
    a rung was not measured. Attributes ``d_prime_5`` and ``d_prime_50``, which 95 % and half of the visible
    vehicles exceed. One ``row`` a vehicle and frame with what it is and ``found_…`` by rung.

    Raises
    ------
    ValueError
        If no frame has a moving vehicle.
    """
    movers = sum(f.movers for f in frames)
    if movers == 0:
        raise ValueError("`case` must have moving vehicles in the window for a ladder, got none")
    visible = sum(len(f.probability) for f in frames)
    counts = dict.fromkeys(RUNGS, np.nan)
    counts |= {"moving": movers, "in_view": sum(f.in_view for f in frames), "visible": visible}
    counts["ideal_observer"] = sum(float(f.probability.sum()) for f in frames)
    false = dict.fromkeys(RUNGS, np.nan)
    found: dict[str, Array] = {"ideal_observer": np.concatenate([f.probability for f in frames])}
    for rung in FOUND:
        if all(rung in f.scored for f in frames):
            least = threshold([f.scored[rung].false for f in frames], false_per_frame)
            found[rung] = np.concatenate([least.detected(f.scored[rung].vehicle) for f in frames])
            false[rung] = float(np.mean([least.detected(f.scored[rung].false).sum() for f in frames]))
    for rung in TRACKED:
        if all(rung in f.held for f in frames):
            found[rung] = np.concatenate([f.held[rung] for f in frames])
    counts |= {rung: float(values.sum()) for rung, values in found.items()}
    told = np.concatenate([f.detectability for f in frames])
    share = np.array([counts[rung] for rung in RUNGS], float)
    of_visible = np.where(np.arange(len(RUNGS)) >= RUNGS.index("visible"), share / max(visible, 1), np.nan)
    quantiles = np.quantile(told, [0.05, 0.5]) if len(told) else np.full(2, np.nan)
    return xr.Dataset(
        {
            "ladder": ("rung", share / movers, {"units": "1"}),
            "of_visible": ("rung", of_visible, {"units": "1"}),
            "false_detections": ("rung", np.array([false[rung] for rung in RUNGS]), {"units": "1"}),
            **_rows(frames, found, told),
        },
        coords={"rung": list(RUNGS)},
        attrs={
            "frames": [f.index for f in frames],
            "false_per_frame": float(false_per_frame),
            "d_prime_5": float(quantiles[0]),
            "d_prime_50": float(quantiles[1]),
        },
    )


def by(rows: xr.Dataset, rung: str, name: str, edges: Array) -> xr.Dataset:
    """Share of the visible movers that a rung finds, in classes of what they are.

    Parameters
    ----------
    rows
        From `ladder`.
    rung
        One of those measured.
    name
        ``length``, ``speed``, ``sunlit`` or ``visible_fraction``.
    edges
        Of the classes, the upper ones not included.
    """
    which = np.digitize(rows[name].values, edges) - 1
    inside = (which >= 0) & (which < len(edges) - 1)
    count = np.bincount(which[inside], minlength=len(edges) - 1)
    total = np.bincount(which[inside], rows[f"found_{rung}"].values[inside], minlength=len(edges) - 1)
    with np.errstate(invalid="ignore"):
        share = total / count
    units = {"units": str(rows[name].attrs.get("units", "1"))}
    return xr.Dataset(
        {"share": (name, share, {"units": "1"}), "vehicles": (name, count, {"units": "1"})},
        coords={name: (name, np.asarray(edges[:-1], float), units)},
    )


def _rows(frames: list[FrameLadder], found: Mapping[str, Array], told: Array) -> dict:
    units = {"length": "m", "speed": "m s-1", "time_s": "s"}
    names = [name for name in frames[0].vehicles] if frames else []
    rows = {name: np.concatenate([f.vehicles[name] for f in frames]) for name in names}
    rows["time_s"] = np.concatenate([np.full(len(f.probability), f.time_s) for f in frames])
    rows["d_prime"] = told
    rows |= {f"found_{rung}": values.astype(float) for rung, values in found.items()}
    return {name: ("row", values, {"units": units.get(name, "1")}) for name, values in rows.items()}
