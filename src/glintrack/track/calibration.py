"""Read calibrated models: logistic models and constants fitted to simulated flights.

Each file of ``data/calibration`` holds what one script fitted, and the range in which it holds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.installation import data_file
from glintrack.io.toml import read_toml


@dataclass(frozen=True)
class LogisticModel:
    """Log odds as a linear function of features.

    Parameters
    ----------
    features
        Names of the features, in the order of the weights.
    intercept
        Log odds where every feature is 0. [nat]
    weights
        Weight of each feature.
    """

    features: tuple[str, ...]
    intercept: float
    weights: Float[Array, "feature"]

    def log_odds(self, features: Float[Array, "item feature"]) -> Float[Array, "item"]:
        """Log odds of each item. [nat]"""
        return self.intercept + features @ self.weights


@dataclass(frozen=True)
class Calibration:
    """Contents of one file of ``data/calibration``.

    Parameters
    ----------
    source
        Script and simulated flights of the fit.
    valid
        Range in which the models hold, by quantity; under a model's name what differs for it.
    models
        By name, for most files the channel: ``pan``, ``dolp`` or ``all``.
    constants
        Other fitted numbers, by name.
    """

    source: str
    valid: Mapping[str, Any]
    models: Mapping[str, LogisticModel]
    constants: Mapping[str, Any]

    def valid_range(self, model: str) -> dict[str, Any]:
        """Range in which one model holds, by quantity."""
        return {**self.valid, **self.valid.get(model, {})}


@cache
def read_calibration(name: str) -> Calibration:
    """Read a calibration by the name of its file, without ``.toml``."""
    values = read_toml(calibration_file(name), "calibration")
    models = {}
    for key, own in values.get("models", {}).items():
        weights = own["weights"]
        models[key] = LogisticModel(tuple(weights), own["intercept"], np.array([*weights.values()], float))
    return Calibration(values["source"], values["valid"], models, values.get("constants", {}))


def calibration_file(name: str) -> Path:
    """Path of a calibration."""
    return data_file("calibration", f"{name}.toml")
