"""Vehicle models by the name of a vehicle type, by its words and SUMO's vehicle classes (vClass).

Whole words are compared, never parts of them: a motorbike is no bike, and a trailer is no rail vehicle.
"""

import itertools
import re

from glintrack.scene.vehicles import VEHICLE_CLASSES

# model and words; the first group that has a word of the name decides, there the last such word: a rail
# replacement bus is a bus, a delivery truck is a truck
_NO_ROAD_VEHICLES = (
    *("pedestrian", "ped", "person", "walker", "wheelchair", "bicycle", "bike", "cyclist", "velo", "scooter"),
    *("escooter", "tram", "streetcar", "rail", "railcar", "train", "subway", "metro", "monorail", "cablecar"),
    *("ship", "ferry", "boat", "container", "aircraft", "airplane", "helicopter", "drone"),
)
_GROUPS: tuple[dict[str | None, tuple[str, ...]], ...] = (
    {
        None: _NO_ROAD_VEHICLES,
        "motorcycle": ("motorcycle", "motorbike", "moped", "motorscooter", "moto", "motorrad"),
        "bus": ("bus", "buses", "minibus", "trolleybus", "coach"),
        "truck": ("truck", "lorry", "lkw", "trailer", "semitrailer", "roadtrain", "hgv", "emergency"),
    },
    {
        "van": ("van", "delivery", "transporter"),
        "suv": ("suv", "jeep", "offroad", "pickup"),
        "hatch": ("hatch", "hatchback", "compact", "small"),
    },
    {"car": ("car", "passenger", "taxi", "private", "sedan", "pkw", "hov", "authority", "army", "vip")},
)
_MODEL_OF = tuple({word: model for model, words in group.items() for word in words} for group in _GROUPS)
_KNOWN = frozenset().union(*_MODEL_OF)
_WORD = re.compile(r"[^\W\d_][a-zà-ÿ]+|[^\W\d_a-zà-ÿ]+")


def model_of(vehicle_type: str) -> str | None:
    """Name of the model for a vehicle type, else a car; None for what is no motor vehicle of the road."""
    if vehicle_type in VEHICLE_CLASSES:
        return vehicle_type
    words = [_singular(word) for word in _WORD.findall(vehicle_type)]
    pairs = [first + second for first, second in itertools.pairwise(["", *words])]  # motor bike, cable car
    found = [pair if pair in _KNOWN else word for pair, word in zip(pairs, words, strict=True)]
    for models in _MODEL_OF:
        for word in reversed(found):
            if word in models:
                return models[word]
    return "car"


def _singular(word: str) -> str:
    """Word in lower case, without the plural's s and without the ``TYPE`` of SUMO's default types."""
    word = word.lower().removesuffix("type")
    return word.removesuffix("s") if word.removesuffix("s") in _KNOWN else word
