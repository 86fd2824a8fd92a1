"""The embedded city: a seeded procedural neighbourhood, by default on the shipped street network.

The streets, with their lanes, crossings and signals, are those SUMO drove on when the traffic was recorded
(``tools/record_embedded_traffic.py``); what stands between them is drawn from the seed. A city of another
size gets streets drawn from its seed, and its traffic from SUMO.
"""

import tempfile
from importlib import resources
from pathlib import Path

import numpy as np
from shapely.geometry import Point, Polygon

from glintrack.scene.objects.layout import Layout, covered_area
from glintrack.scene.objects.surfaces import road_areas
from glintrack.scene.sources.neighbourhood import Use, neighbourhood, use_by_size
from glintrack.scene.sources.embedded import (
    NETCONVERT,
    NETWORK_MARGIN_M,
    SHIPPED_PLAN,
    draw_plan,
    plan_xml,
)
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.traffic import Recording, read_recording
from glintrack.scene.read.sumo import FULL_MIX, SumoRun, recorded

# Points inside the blocks of the shipped plan that are not housing; see `street_plan.SHIPPED_PLAN`. [m]
_SHOPPING, _OFFICES, _PARK = Point(25, -65), Point(195, -15), Point(-225, 135)
_TOWN = tuple(
    Point(p) for p in ((25, 88), (-100, -15), (-100, 88), (255, 88), (365, 88), (365, -15), (150, 88))
)
_SHIPPED_PERIOD_S, _SHIPPED_GRID_M2 = 0.44, 1060.0 * 790.0


def embedded_recording() -> Recording:
    """The shipped street network and traffic."""
    source = resources.files("glintrack") / "data" / "traffic" / "embedded.nc"
    with resources.as_file(source) as path:
        return read_recording(path)


def drawn_recording(
    extent_m: tuple[float, float, float, float],
    margin_m: float,
    seed: int,
    warmup_s: float,
    duration_s: float,
    insertion_period_s: float | None,
    shipped: bool = False,
) -> Recording:
    """Streets drawn from a seed for a window of any size, and SUMO's traffic on them.

    Parameters
    ----------
    extent_m
        West, south, east, north of the window. [m]
    margin_m
        Traffic is kept this far beyond it. [m]
    seed
        Of the streets and of the trips.
    warmup_s, duration_s
        SUMO time before the recording, and its length. [s]
    insertion_period_s
        One vehicle enters each such interval; by default as many an area as in the shipped recording. [s]
    shipped
        Drive on the streets of the shipped recording instead.
    """
    west, south, east, north = extent_m
    if insertion_period_s is None:
        grid_m2 = (east - west + 2 * NETWORK_MARGIN_M) * (north - south + 2 * NETWORK_MARGIN_M)
        insertion_period_s = round(max(_SHIPPED_PERIOD_S * _SHIPPED_GRID_M2 / grid_m2, 0.05), 2)
    rng = np.random.default_rng(seed)
    plan = SHIPPED_PLAN if shipped else draw_plan(east - west, north - south, rng)
    with tempfile.TemporaryDirectory(prefix="glintrack-streets-") as scratch:
        paths = Path(scratch) / "city.nod.xml", Path(scratch) / "city.edg.xml"
        for path, text in zip(paths, plan_xml(plan), strict=True):
            path.write_text(text, encoding="utf-8")
        return recorded(
            SumoRun(
                inputs=paths,
                netconvert=("-n", paths[0].name, "-e", paths[1].name, *NETCONVERT),
                extent_m=(west - margin_m, south - margin_m, east + margin_m, north + margin_m),
                origin_m=(0.0, 0.0),
                warmup_s=warmup_s,
                duration_s=duration_s,
                insertion_period_s=insertion_period_s,
                seed=seed,
                mix=FULL_MIX,
            )
        )


def embedded_layout(
    network: RoadNetwork,
    extent_m: tuple[float, float, float, float],
    rng: np.random.Generator,
    shipped: bool = True,
) -> Layout:
    """Fill the blocks of the street network.

    Parameters
    ----------
    network
        Streets.
    extent_m
        West, south, east, north of the window. [m]
    rng
        Draws everything.
    shipped
        The streets are the shipped ones, whose blocks have planned uses; else each has what its size suits.
    """
    area = covered_area(extent_m)
    streets = road_areas(network, area)
    return neighbourhood(network, streets, area, _planned_use if shipped else use_by_size, rng)


def _planned_use(block: Polygon, rng: np.random.Generator) -> Use:
    if block.contains(_SHOPPING):
        return "shopping"
    if block.contains(_OFFICES):
        return "offices"
    if block.contains(_PARK):
        return "park"
    return "town" if any(block.contains(p) for p in _TOWN) else "housing"
