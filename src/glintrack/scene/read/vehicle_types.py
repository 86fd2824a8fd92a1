"""Vehicle models by the name of a vehicle type, by its words and SUMO's vehicle classes (vClass).

Whole words are compared, never parts of them: a motorbike is no bike, and a trailer is no rail vehicle.
"""

import itertools
import re
from functools import cache

from glintrack.core.installation import read_data
from glintrack.scene.vehicles import VEHICLE_CLASSES

_WORD = re.compile(r"[^\W\d_][a-zà-ÿ]+|[^\W\d_a-zà-ÿ]+")


def model_of(vehicle_type: str) -> str | None:
    """Name of the model for a vehicle type, else a car; None for what is no motor vehicle of the road."""
    if vehicle_type in VEHICLE_CLASSES:
        return vehicle_type
    groups = _read_groups()
    known = {word for models in groups for word in models}
    bare = [
        word.lower().removesuffix("type") for word in _WORD.findall(vehicle_type)
    ]  # as of SUMO's defaults
    words = [word.removesuffix("s") if word.removesuffix("s") in known else word for word in bare]
    pairs = [first + second for first, second in itertools.pairwise(["", *words])]  # motor bike, cable car
    found = [pair if pair in known else word for pair, word in zip(pairs, words, strict=True)]
    for models in groups:
        for word in reversed(found):
            if word in models:
                return None if models[word] == "none" else models[word]
    return "car"


@cache
def _read_groups() -> list[dict[str, str]]:
    """Model of each word, ``none`` for no road vehicle, in groups of which the first that matches counts."""
    groups = read_data("traffic", "vehicle_types.toml")["groups"]
    return [{word: model for model, words in group.items() for word in words} for group in groups]
