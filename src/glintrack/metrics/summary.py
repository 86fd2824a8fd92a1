"""Scores of a whole run: what the report leads with, and what stands beside it."""

from collections.abc import Sequence

import numpy as np

from glintrack.metrics.custody import custody_scores
from glintrack.metrics.tracks import EpochScore, as_sequence, completeness, identity_switches, purity

HEADLINE = ("held_per_km2", "completeness", "completeness_visible", "custody", "false_per_km2")


def summarize(epochs: Sequence[EpochScore] | EpochScore) -> dict[str, float]:
    """Scores of a whole run, means over its epochs; NaN where nothing could be scored.

    Returns
    -------
    The headline: ``held_per_km2`` (moving vehicles of the window that have a track) [km⁻²], ``completeness``
    of all movers, ``completeness_visible``, ``custody`` [1] and ``false_per_km2`` [km⁻²]. Beside it:
    ``completeness_all``, ``purity`` [1], ``false_per_epoch``, ``tracks_per_epoch``, ``vehicles_per_epoch``
    (that should be tracked), ``identity_switches``, what `custody_scores` gives, ``position_rms_m`` of valid
    tracks [m], ``epochs``.
    """
    epochs = as_sequence(epochs)
    errors = np.concatenate([e.distance_m[e.valid] for e in epochs]) if epochs else np.empty(0)
    return {
        "held_per_km2": _mean([e.valid.sum() / e.area_km2 for e in epochs]),
        "completeness": _mean(completeness(epochs)),
        "completeness_visible": _mean(completeness(epochs, "visible")),
        "completeness_all": _mean(completeness(epochs, "all")),
        "purity": purity(epochs),
        **custody_scores(epochs),
        "false_per_epoch": _mean([e.false.sum() for e in epochs]),
        "false_per_km2": _mean([e.false.sum() / e.area_km2 for e in epochs]),
        "tracks_per_epoch": _mean([len(e.track_ids) for e in epochs]),
        "vehicles_per_epoch": _mean([e.should.sum() for e in epochs]),
        "identity_switches": float(identity_switches(epochs)),
        "position_rms_m": float(np.sqrt(_mean(errors**2))),
        "epochs": float(len(epochs)),
    }


def _mean(values) -> float:
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else float("nan")
