"""One plain Rayleigh slab, so that anyone can repeat the published rows with one call."""

import numpy as np
import sasktran2 as sk
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.atmosphere.solve import NEAR_VERTICAL
from glintrack.core.arrays import Array

_DEPTH_M = 1000.0
LEVELS = 2


def rayleigh_slab(
    optical_depth: float,
    mu0: float,
    albedo: float,
    mu: ArrayLike,
    azimuth_deg: ArrayLike,
    streams: int = 40,
) -> Float[Array, "... 3"]:
    """Light leaving the top of a homogeneous Rayleigh slab without depolarization, for a solar flux of π.

    Parameters
    ----------
    optical_depth
        Vertical, above 0. [1]
    mu0
        Cosine of the sun's zenith angle, in (0, 1]. [1]
    albedo
        Of the Lambertian ground below, 0 to 1. [1]
    mu
        Cosine of the angle of the emerging light from the vertical, in (0, 1]; broadcasts with
        ``azimuth_deg``. [1]
    azimuth_deg
        Azimuth of the direction of *travel* from the sunbeam's: 0 is forward scattering, counter-clockwise
        seen from above, as in the published tables. [°]
    streams
        Discrete ordinates over the full sphere, even.

    Returns
    -------
    I, Q, U in our `meridian` frame: Q is the opposite of the tables', U the same. [sr⁻¹]

    References
    ----------
    Coulson, Dave and Sekera, *Tables Related to Radiation Emerging from a Planetary Atmosphere with Rayleigh
    Scattering* (1960); Natraj, Li and Yung, Astrophys. J. 691, 1909 (2009).
    """
    for name, value, low, high in (
        ("optical_depth", optical_depth, 0.0, np.inf),
        ("mu0", mu0, 0.0, 1.0),
        ("mu", np.min(mu), 0.0, 1.0),
        ("mu", np.max(mu), 0.0, 1.0),
    ):
        if not low < value <= high:
            raise ValueError(f"`{name}` must be above {low:g} and at most {high:g}, got {value:g}")
    if not 0 <= albedo <= 1:
        raise ValueError(f"`albedo` must lie within 0 to 1, got {albedo:g}")
    if streams % 2 or streams < 4:
        raise ValueError(f"`streams` must be even and at least 4, got {streams}")
    mu, azimuth = np.broadcast_arrays(np.asarray(mu, dtype=float), np.radians(azimuth_deg))

    config = sk.Config()
    config.num_stokes, config.num_streams, config.num_singlescatter_moments = 3, streams, streams
    config.multiple_scatter_source = sk.MultipleScatterSource.DiscreteOrdinates
    # A homogeneous plane slab is one layer, in which the ordinates' own single scatter is exact
    config.single_scatter_source = sk.SingleScatterSource.DiscreteOrdinates
    config.log_level = sk.LogLevel.Off
    geometry = sk.Geometry1D(
        mu0,
        0.0,
        6.371e6,
        np.linspace(0.0, _DEPTH_M, LEVELS),
        sk.InterpolationMethod.LinearInterpolation,
        sk.GeometryType.PlaneParallel,
    )
    rays = sk.ViewingGeometry()
    for one_mu, one_azimuth in zip(mu.ravel(), azimuth.ravel(), strict=True):
        # tables count azimuth counter-clockwise, the solver clockwise
        rays.add_ray(sk.GroundViewingSolar(mu0, -one_azimuth, min(one_mu, NEAR_VERTICAL), 10 * _DEPTH_M))
    slab = sk.Atmosphere(geometry, config, numwavel=1, calculate_derivatives=False)
    slab.storage.total_extinction[:] = optical_depth / _DEPTH_M
    slab.storage.ssa[:] = 1.0
    slab.leg_coeff.a1[0] = 1.0
    slab.leg_coeff.a1[2] = 0.5
    slab.leg_coeff.a2[2] = 3.0  # pyright: ignore[reportOptionalSubscript]
    slab.leg_coeff.b1[2] = np.sqrt(6) / 2  # pyright: ignore[reportOptionalSubscript]
    slab.surface.albedo[:] = albedo
    light = sk.Engine(config, geometry, rays).calculate_radiance(slab)["radiance"].values
    return np.pi * light.reshape(*mu.shape, 3)
