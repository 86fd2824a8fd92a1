"""What the rays of a frame met: the record between `trace` and `shade`."""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.arrays import Array


@dataclass(frozen=True)
class Hits:
    """What each ray of a frame met; rays run row by row over the (oversampled) array.

    Parameters
    ----------
    rows, columns, oversampling
        Elements of the array, and rays along each side of an element.
    detector_axis
        The detector's +x in ENU, the reference axis of the ``detector`` Stokes frame. [1]
    direction
        Unit direction of look. [1]
    point
        Hit point in ENU. [m]
    normal
        Facet normal, turned toward the camera. [1]
    range_m
        Distance from the lens; infinite for sky. [m]
    material
        Index into the materials; −1 for sky.
    vehicle_id
        The vehicle hit, −1 for none.
    sun_visible
        Part of the sun's light that arrives, 0 to 1; 0 where the sun stands behind the facet, unless that is
        a leaf card (a material with a gap fraction): then what arrives at its back. [1]
    sky_view
        Sky irradiance of the facet over that of the same facet in the open, both under an even sky:
        V = ∫ v cos θ dω / ∫ cos θ dω over the directions above the horizon and in front of the facet, v
        being 1 where sky is seen and 0 elsewhere. An open facet of any tilt has V = 1, and (1 + n_z)/2 · V
        of its cosine-weighted hemisphere is sky. 0 to 1. [1]
    sky_behind
        The same of the other side of a leaf card, whose normal is −n; 0 for all else. [1]
    mirror_material
        Material that the mirror-reflected ray of a smooth surface meets; −1 where it meets the sky, or was
        not followed because the surface is rough.
    mirror_sun
        Cosine of the sun's incidence on what that ray meets, times the part of the sun's light that arrives
        there; 0 in shadow and where ``mirror_material`` is −1. [1]
    mirror_sky
        Cosine-weighted part of the hemisphere over what that ray meets that is sky, (1 + n_z)/2 · V; 0 where
        ``mirror_material`` is −1. [1]
    """

    rows: int
    columns: int
    oversampling: int
    detector_axis: Float[Array, "3"]
    direction: Float[Array, "ray 3"]
    point: Float[Array, "ray 3"]
    normal: Float[Array, "ray 3"]
    range_m: Float[Array, "ray"]
    material: Int[Array, "ray"]
    vehicle_id: Int[Array, "ray"]
    sun_visible: Float[Array, "ray"]
    sky_view: Float[Array, "ray"]
    sky_behind: Float[Array, "ray"]
    mirror_material: Int[Array, "ray"]
    mirror_sun: Float[Array, "ray"]
    mirror_sky: Float[Array, "ray"]


def one_ray_each(hits: Hits) -> Hits:
    """Keep of each element the one ray nearest its centre (of two, the one past it): for looking at."""
    n = hits.oversampling
    if n == 1:
        return hits
    row, column = np.ix_(np.arange(hits.rows) * n + n // 2, np.arange(hits.columns) * n + n // 2)
    kept = (row * hits.columns * n + column).reshape(-1)
    rays = (
        f.name for f in fields(Hits) if f.name not in ("rows", "columns", "oversampling", "detector_axis")
    )
    return replace(hits, oversampling=1, **{name: getattr(hits, name)[kept] for name in rays})
