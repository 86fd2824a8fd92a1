"""Superpixels by name: kinds of elements, and the condition of their polarizers for S0, S1 and S2."""

import math
import re
from typing import Literal

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

MIRROR, OPEN = "mirror", "open"
Superpixel = tuple[tuple[str | float, ...], ...]
Demosaicker = Literal["superpixel", "bilinear", "ppid", "eari"]  # `sensor.demosaicking.demosaic`
# rows from the top; a number is a polarizer's pass axis from the detector's +x, counter-clockwise as seen
# looking at the source [deg]; two numbers are the band of a filter [µm]
LAYOUTS: dict[str, Superpixel] = {
    "mirror-0-60-120": ((MIRROR, 0.0), (60.0, 120.0)),  # the paper's, §3.2
    "0-45-90-135": ((90.0, 45.0), (135.0, 0.0)),  # as sold: Sony Polarsens, by its flyer
    "pan": ((OPEN,),),
    "mirror": ((MIRROR,),),  # a multi-object spectrometer alone
    "rgb": (("0.6-0.7", "0.5-0.6"), ("0.5-0.6", "0.4-0.5")),  # Bayer; thirds of the visible
    "four-bands": (("0.45-0.52", "0.52-0.6"), ("0.63-0.69", "0.76-0.9")),  # Landsat Thematic Mapper 1 to 4
}
_FILTER = re.compile(r"(\d*\.?\d+)-(\d*\.?\d+)")
LARGEST = 4  # elements along a superpixel's side
LARGEST_CONDITION = 50.0  # noise of S1 and S2 is then some fifty times that of S0


def superpixel(layout: str | Superpixel, name: str = "sensor.layout") -> Superpixel:
    """Polarizer, filter, mirror or nothing over each element of a superpixel.

    Parameters
    ----------
    layout
        A name of `LAYOUTS`, or the matrix itself: ``"mirror"``, ``"open"``, a polarizer's angle [deg], or a
        filter's band such as ``"0.5-0.6"`` [µm].
    name
        What the user calls it.

    Raises
    ------
    ValueError
        If the name is unknown, the matrix is not square, holds something else, more than one mirror, or both
        filters and polarizers.
    """
    if isinstance(layout, str):
        if layout not in LAYOUTS:
            raise ValueError(f"`{name}` must be one of {', '.join(LAYOUTS)} or a matrix; got {layout!r}.")
        return LAYOUTS[layout]
    sides = {len(layout), *(len(row) for row in layout)}
    if len(sides) != 1 or not 1 <= len(layout) <= LARGEST:
        raise ValueError(
            f"`{name}` must be square, 1 to {LARGEST} elements a side; "
            f"got rows of {[len(row) for row in layout]}."
        )
    kinds = [what for row in layout for what in row]
    filters = [w for w in kinds if filter_band(w)]
    strange = [w for w in kinds if w not in (MIRROR, OPEN, *filters) and not isinstance(w, float | int)]
    if strange or not all(math.isfinite(w) for w in kinds if not isinstance(w, str)):
        raise ValueError(
            f"`{name}` must hold {MIRROR!r}, {OPEN!r}, angles in degrees or bands of filters in µm such as "
            f"'0.5-0.6'; got {strange or kinds}."
        )
    if filters and not all(isinstance(w, str) for w in kinds):
        raise ValueError(f"`{name}` must hold filters or polarizers, not both; got {kinds}.")
    if kinds.count(MIRROR) > 1:
        raise ValueError(f"`{name}` must hold one mirror at most; got {kinds.count(MIRROR)}.")
    return tuple(tuple(w if isinstance(w, str) else float(w) for w in row) for row in layout)


def filter_band(what: str | float) -> tuple[float, float] | None:
    """Band of the filter over an element, None for an element of another kind. [µm]"""
    found = _FILTER.fullmatch(what) if isinstance(what, str) else None
    first, last = (float(um) for um in found.groups()) if found else (0.0, 0.0)
    return (first, last) if first < last else None


def check_demosaicker(method: str, layout: Superpixel, name: str = "sensor.demosaic") -> None:
    """Refuse a demosaicker that the superpixel does not suit.

    Raises
    ------
    ValueError
        If it is ``"eari"``, and the superpixel has polarizers and is not 2 × 2.
    """
    side = len(layout)
    if method == "eari" and side != 2 and places(layout, "polarizer"):
        raise ValueError(
            f"`{name}` must be superpixel, bilinear or ppid for superpixels of {side} × {side}; got "
            "'eari', which needs 2 × 2."
        )


def places(layout: Superpixel, kind: str) -> list[tuple[int, int]]:
    """(row, column) of the elements of one kind: ``"mirror"``, ``"open"`` or ``"polarizer"``."""
    return [
        (i, j)
        for i, row in enumerate(layout)
        for j, what in enumerate(row)
        if what == kind or (kind == "polarizer" and not isinstance(what, str))
    ]


def pan_element(layout: Superpixel) -> tuple[int, int] | None:
    """(row, column) of the element of pan: the mirror, else an open one; None where pan is S0."""
    found = places(layout, MIRROR) + places(layout, OPEN)
    return found[0] if found else None


def analyser_matrix(
    layout: Superpixel, diattenuation: float | Float[Array, "polarizer"]
) -> Float[Array, "polarizer 3"]:
    """Response of each polarizer to S0, S1 and S2, if unpolarized light reads as S0. [1]

    Parameters
    ----------
    layout
        From `superpixel`.
    diattenuation
        Of the polarizers, band-averaged; 1 for ideal ones. [1]

    Returns
    -------
    Rows 1, D cos 2θ, D sin 2θ, in the order of `places`.
    """
    angle = np.radians([2.0 * float(layout[i][j]) for i, j in places(layout, "polarizer")])
    d = np.broadcast_to(np.asarray(diattenuation, float), angle.shape)
    return np.stack([np.ones_like(angle), d * np.cos(angle), d * np.sin(angle)], axis=1)


def invert(matrix: Float[Array, "polarizer 3"], name: str = "sensor.layout") -> Float[Array, "3 polarizer"]:
    """Least-squares inverse of `analyser_matrix`; Fesenkov's formula for ideal 0°, 60°, 120°. [1]

    Raises
    ------
    ValueError
        If the polarizers do not determine the three components, with the condition number.
    """
    number = condition_number(matrix)
    if not number <= LARGEST_CONDITION:
        raise ValueError(
            f"`{name}` must hold polarizers that determine S0, S1 and S2; got a condition number of "
            f"{number:.3g}, more than {LARGEST_CONDITION:g}. Take three angles, and polarizers that "
            "diattenuate in the band."
        )
    return np.linalg.pinv(matrix)


def condition_number(matrix: Float[Array, "polarizer 3"]) -> float:
    """Largest over smallest singular value; infinite for fewer than three polarizers. [1]"""
    if len(matrix) < 3:
        return math.inf
    return float(np.linalg.cond(matrix)) if np.isfinite(matrix).all() else math.inf
