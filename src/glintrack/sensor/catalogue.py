"""Catalogue of real detector arrays and lenses: figures that were read in data sheets, with their sources."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

from glintrack.core.designs import suggest_name

_FOLDER = resources.files("glintrack") / "data" / "catalogue"


@dataclass(frozen=True)
class CatalogueItem:
    """A detector array or a lens: figures as read, and the page of each, or "assumed"."""

    name: str
    title: str
    figures: Mapping[str, Any]
    sources: Mapping[str, str]


def read_catalogue(kind: Literal["detectors", "lenses"]) -> dict[str, CatalogueItem]:
    """Read the detector arrays or the lenses, by name."""
    tables = tomllib.loads((_FOLDER / f"{kind}.toml").read_text(encoding="utf-8"))
    pages, items = tables.pop("pages"), {}
    for name, row in tables.items():
        read, assumed, title = row.pop("read"), row.pop("assumed", ()), row.pop("title")
        sources = {figure: pages[page] for page, figures in read.items() for figure in figures}
        items[name] = CatalogueItem(name, title, row, sources | dict.fromkeys(assumed, "assumed"))
    return items


def find_item(kind: Literal["detectors", "lenses"], name: str) -> CatalogueItem:
    """Find a detector array or a lens by name; a ValueError suggests the most similar one."""
    items, option = read_catalogue(kind), "--lens" if kind == "lenses" else "--sensor"
    if name not in items:
        hint = suggest_name(name, items)
        raise ValueError(f"`{option}` must be one of `glintrack sensor list`; got {name!r}. {hint}")
    return items[name]


def electrons_of(item: CatalogueItem) -> dict[str, float]:
    """Full well and read noise of a detector array, if they are known. [e]

    By EMVA 1288 the signal-to-noise ratio at saturation is the root of the full well. The dynamic range is
    the full well over the threshold √(σ² + 1/4) + 1/2 of the dark noise σ.

    References
    ----------
    EMVA Standard 1288, Release 3.1 (2016), Section 2.
    """
    figures = item.figures
    if "snr_max_db" not in figures:
        return {key: figures[key] for key in ("full_well_e", "read_noise_e") if key in figures}
    full_well_e = 10 ** (figures["snr_max_db"] / 10)
    threshold_e = full_well_e / 10 ** (figures["dynamic_range_db"] / 20)
    noise_e = math.sqrt(max((threshold_e - 0.5) ** 2 - 0.25, 0.0))
    return {"full_well_e": float(f"{full_well_e:.3g}"), "read_noise_e": float(f"{noise_e:.3g}")}
