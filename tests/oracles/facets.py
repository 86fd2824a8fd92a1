"""Mueller matrix of a rough surface's facets for one pair of directions, to hold sums over facets against."""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.render.shading.materials import DISTRIBUTIONS, facet_lobe, fresnel
from glintrack.stokes import axis_turn


def reflection_mueller(
    view: Float[Array, "3"],
    light: Float[Array, "3"],
    alpha: float,
    n: float,
    k: float = 0.0,
    distribution: str = "ggx",
) -> Float[Array, "3 3"]:
    """Mueller matrix (I, Q, U) of the facets' bidirectional reflectance.

    Parameters
    ----------
    view, light
        Unit vectors from the surface, whose normal is +z, toward the viewer and toward the light. [1]
    alpha
        Roughness, above 0. [1]
    n, k
        Complex refractive index. [1]
    distribution
        One of `DISTRIBUTIONS`.

    Returns
    -------
    Both light and view in the ``meridian`` frame of the surface. [sr⁻¹]

    Raises
    ------
    ValueError
        If the model is not a known one.
    """
    if distribution not in DISTRIBUTIONS:
        raise ValueError(f"`distribution` must be one of {', '.join(DISTRIBUTIONS)}; got {distribution!r}")
    v, l = np.asarray(view, dtype=float), np.asarray(light, dtype=float)
    half = (v + l) / np.linalg.norm(v + l)
    m00, m01, m22 = fresnel(float(v @ half), float(n), float(k))
    lobe = facet_lobe(DISTRIBUTIONS.index(distribution), half[2], v[2], l[2], float(alpha))
    s = np.cross(v, l) if np.linalg.norm(np.cross(v, l)) > 1e-9 else np.array([1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, 1.0]) if max(v[2], l[2]) < 1 - 1e-12 else np.array([0.0, 1.0, 0.0])
    arrive = _turn_matrix(*axis_turn(*up, *s, *(-l)))
    leave = _turn_matrix(*axis_turn(*s, *up, *v))
    facet = np.array([[m00, m01, 0.0], [m01, m00, 0.0], [0.0, 0.0, m22]])
    return lobe * leave @ facet @ arrive


def _turn_matrix(cos2: float, sin2: float) -> Float[Array, "3 3"]:
    return np.array([[1.0, 0.0, 0.0], [0.0, cos2, sin2], [0.0, -sin2, cos2]])
