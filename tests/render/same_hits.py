"""Whether two frames' hits are the same, however their probes are numbered."""

import numpy as np
from jaxtyping import Int

from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.render import Hits
from glintrack.render.light.lattice import SPACE
from glintrack.render.shading.hits import PROBES, samples_of, take_samples


def lit_by(hits: Hits, codes: np.ndarray, behind: bool = False) -> list[np.ndarray]:
    """What the four probes of each sample's cell hold; zeros for the whole sky."""
    cells = np.where(codes >= 0, codes, (SPACE - codes) ^ (7 if behind else 0))
    somewhere = (codes >= 0) | (codes <= SPACE)
    rows = (
        hits.probe_cells[np.where(somewhere, cells, 0)] if somewhere.any() else np.zeros((len(codes), 4), int)
    )
    held = []
    for name in PROBES[1:]:
        values = getattr(hits, name)
        found = (
            values[rows] if somewhere.any() else np.zeros((len(codes), 4, *values.shape[1:]), values.dtype)
        )
        held.append(np.where(somewhere.reshape(-1, *[1] * (found.ndim - 1)), found, 0))
    return held


def assert_same_hits(one: Hits, other: Hits) -> None:
    """Every field bit for bit; of cells and probes what samples find there, from either side."""
    cells = ("light_cell", "mirror_cell")
    for name in Hits._fields:
        if name not in (*PROBES, *cells):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    for name in cells:
        mine, others = getattr(one, name), getattr(other, name)
        np.testing.assert_array_equal(np.sign(mine + 1), np.sign(others + 1))  # facet, whole sky or space
        for behind in (False, True):
            for a, b in zip(lit_by(one, mine, behind), lit_by(other, others, behind), strict=True):
                np.testing.assert_array_equal(a, b)


def of_elements(hits: Hits, elements: Int[Array, "element"]) -> Hits:
    """Samples of some elements alone."""
    counts, rays = np.zeros_like(np.diff(hits.first)), np.zeros_like(hits.rays)
    counts[elements], rays[elements] = np.diff(hits.first)[elements], hits.rays[elements]
    return take_samples(hits, samples_of(hits, np.sort(elements)), counts)._replace(rays=rays)


def small_case(**sensor) -> Case:
    """A small sensor looking at three cars."""
    return Case.model_validate(
        {
            "name": "three cars",
            "flight": {"off_nadir_deg": 30.0, "altitude_m": 2600.0, "frames": 2},
            "sensor": {"rows": 160, "columns": 200, "oversampling": 2, **sensor},
        }
    )
