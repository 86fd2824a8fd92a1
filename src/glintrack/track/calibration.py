"""Read calibrated models: logistic models and constants fitted to simulated flights.

Each file of ``data/calibration`` holds what one script fitted, and the range in which it holds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.toml import read_toml, to_toml


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
    """What one file of ``data/calibration`` holds.

    Parameters
    ----------
    source
        Script and simulated flights of the fit.
    valid
        Range in which the models hold, by quantity.
    models
        By name, for most files the channel: ``pan``, ``dolp`` or ``all``.
    constants
        Other fitted numbers, by name.
    """

    source: str
    valid: Mapping[str, Any]
    models: Mapping[str, LogisticModel]
    constants: Mapping[str, Any]


@cache
def read_calibration(name: str) -> Calibration:
    """Read a calibration by the name of its file, without ``.toml``."""
    values = read_toml(_file(name), "calibration")
    models = {}
    for key, own in values["models"].items():
        weights = own["weights"]
        models[key] = LogisticModel(tuple(weights), own["intercept"], np.array([*weights.values()], float))
    return Calibration(values["source"], values["valid"], models, values.get("constants", {}))


def write_calibration(name: str, calibration: Calibration, digits: int = 2) -> None:
    """Write a calibration with rounded weights, and let `read_calibration` read it anew."""
    models = {}
    for key, model in calibration.models.items():
        weights = [round(float(weight), digits) for weight in model.weights]
        own = dict(zip(model.features, weights, strict=True))
        models[key] = {"intercept": round(float(model.intercept), digits), "weights": own}
    values = {"source": calibration.source, "valid": dict(calibration.valid), "models": models}
    if calibration.constants:
        values["constants"] = dict(calibration.constants)
    _file(name).write_text(to_toml(values), encoding="utf-8")
    read_calibration.cache_clear()


def _file(name: str) -> Path:
    return Path(str(resources.files("glintrack"))) / "data" / "calibration" / f"{name}.toml"
