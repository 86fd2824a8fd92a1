"""What a rough surface mirrors at its place, beside the open sky and the frame's mean surroundings.

    W_b(n) = ∫_b D(n·h) F(v·h) G(n·l) L(l) dω / ∫ D F G L dω,   h = (l + v)/|l + v|

is the share of patch b of the sky in the light that a facet of normal n mirrors toward the lens. Probes know
which part of each patch is open: the sky counts Σ_b v_b W_b at a place, not its whole view of the sky. The
shares are those of one lobe, of α = 0.45 as nearly all rough materials have, for the frame's mean direction
of look. Surroundings count by the irradiance that the probes get off surfaces over what the frame's mean
surfaces would send from as much of the hemisphere.

Both are two more components of what probes are lit by (`probe_light`), after the diffuse ones.
"""

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.render.shading.normals import node_normals
from glintrack.render.sky import Sky, look_up_all
from glintrack.render.sky_patches import PATCHES, even_directions, patch_of

PLACE_COMPONENTS = 2  # the sky mirrored, and light off surfaces
_ALPHA, _REFLECTANCE = 0.45, 0.04  # of the lobe; at normal incidence, of glass and bitumen
_DIRECTIONS, _LOOKS = 512, 1024
MOST_LOCAL = 4.0  # light off surfaces at a place, over that of the frame's mean surfaces


def mirrored_patches(
    sky: Sky, look: Float[Array, "look 3"], weights: Float[Array, "wavelength"]
) -> Float[Array, "normal patch"]:
    """Share of each patch in what facets mirror; of the nodes of `node_normals`, each row sums to 1.

    Parameters
    ----------
    sky
        Its radiance by direction.
    look
        Directions of look, of which the mean counts. [1]
    weights
        What of each wavelength is looked at. [1]
    """
    light = even_directions(_DIRECTIONS)
    radiance = look_up_all(sky.sky_map, light)[0][..., 0] @ (sky.sky_spectrum @ weights)
    view = -np.asarray(look[:: max(len(look) // _LOOKS, 1)], float).mean(axis=0)
    view /= max(float(np.linalg.norm(view)), 1e-9)
    half = light + view
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    normals, steep = node_normals().astype(np.float32), np.float32(_ALPHA**2)
    toward, lit = (np.maximum(normals @ x.T.astype(np.float32), 0) for x in (half, light))
    facets = (steep / (1 + (steep - 1) * toward**2)) ** 2  # GGX, without its constant
    masked = 2 * lit / (lit + np.sqrt(steep + (1 - steep) * lit**2))
    fresnel = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - np.clip(half @ view, 0, 1)) ** 5
    patches = np.eye(PATCHES)[patch_of(light, sky.sun_direction)] * (fresnel * radiance)[:, None]
    shares = (facets * masked) @ patches.astype(np.float32)
    total = shares.sum(axis=1, keepdims=True)
    return np.divide(shares, total, out=np.full_like(shares, 1 / PATCHES), where=total > 0)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def mirrored_here(around, left, sky_part, followed):
    """Part of the sky that a place mirrors, and the light of its surroundings over the frame's mean. [1]

    Parameters
    ----------
    around
        Its last two are those of the place.
    left
        What vehicles that move leave. [1]
    sky_part
        Of the facet's hemisphere. [1]
    followed
        Whether light off surfaces is known.
    """
    last = around.shape[0] - 1
    sky = min(max(left * around[last - 1], 0.0), 1.0)
    if not followed:
        return sky, 1.0
    return sky, min(max(around[last], 0.0) / max(1.0 - sky_part, 0.05), MOST_LOCAL)
