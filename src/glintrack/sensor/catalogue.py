"""Catalogue of real detector arrays and lenses: figures that were read in data sheets, with their sources."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from glintrack.core.designs import suggest_name
from glintrack.core.installation import read_data

Kind = Literal["detectors", "lenses"]


@dataclass(frozen=True)
class CatalogueItem:
    """A detector array or a lens: its figures as keys of ``[sensor]``, and the page of each, or "assumed".

    A lens has its smallest F-number, and its ``image_circle_mm``.
    """

    name: str
    title: str
    figures: Mapping[str, Any]
    sources: Mapping[str, str]

    def source(self, figure: str) -> str:
        """Name of the page of a figure, without its address; or "assumed"."""
        return self.sources[figure].split(", http")[0]


@cache
def read_catalogue(kind: Kind) -> Mapping[str, CatalogueItem]:
    """Read the detector arrays or the lenses, by name."""
    tables = read_data("catalogue", f"{kind}.toml")
    pages, assumed, items = tables.pop("pages"), tables.pop("assumed", {}), {}
    for name, row in tables.items():
        read, title = row.pop("read"), row.pop("title")
        sources = {figure: pages[page] for page, figures in read.items() for figure in figures}
        if "snr_max_db" in row:
            electrons = _electrons(row.pop("snr_max_db"), row.pop("dynamic_range_db"))
            row, sources = row | electrons, dict.fromkeys(electrons, sources.get("snr_max_db")) | sources
        row = assumed | row
        items[name] = CatalogueItem(name, title, row, {key: sources.get(key) or "assumed" for key in row})
    return items


def find_item(kind: Kind, name: str) -> CatalogueItem:
    """Find a detector array or a lens by name; a ValueError suggests the most similar one."""
    items, option = read_catalogue(kind), "--lens" if kind == "lenses" else "--sensor"
    if name not in items:
        hint = suggest_name(name, items)
        raise ValueError(f"`{option}` must be one of `glintrack sensor list`; got {name!r}. {hint}")
    return items[name]


def _electrons(snr_max_db: float, dynamic_range_db: float) -> dict[str, float]:
    """Full well and read noise of a detector array. [e]

    By EMVA 1288 the signal-to-noise ratio at saturation is the root of the full well. The dynamic range is
    the full well over the threshold √(σ² + 1/4) + 1/2 of the dark noise σ.

    References
    ----------
    EMVA Standard 1288, Release 3.1 (2016), Section 2.
    """
    full_well_e = 10 ** (snr_max_db / 10)
    threshold_e = full_well_e / 10 ** (dynamic_range_db / 20)
    noise_e = math.sqrt(max((threshold_e - 0.5) ** 2 - 0.25, 0.0))
    return {"full_well_e": float(f"{full_well_e:.3g}"), "read_noise_e": float(f"{noise_e:.3g}")}
