"""Constant-velocity Kalman filter on arrays of targets.

State ``[east, north, east speed, north speed]``, white-noise acceleration, position measured.

References
----------
Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), §6.2.2.
"""

import numba as nb
import numpy as np
from jaxtyping import Float

Array = np.ndarray


def predict(
    mean: Float[Array, "track 4"],
    covariance: Float[Array, "track 4 4"],
    interval_s: float,
    acceleration_psd_m2_s3: float,
    damping_s: Float[Array, "track"] | None = None,
) -> tuple[Float[Array, "track 4"], Float[Array, "track 4 4"]]:
    """States after ``interval_s`` of motion at constant velocity.

    Parameters
    ----------
    mean, covariance
        Of each target. [m, m s⁻¹]
    interval_s
        Time step. [s]
    acceleration_psd_m2_s3
        Power density of the white acceleration on each axis. [m² s⁻³]
    damping_s
        Time in which a target's speed decays; infinite (the default) keeps it. [s]

    Returns
    -------
    Predicted mean and covariance, new arrays.
    """
    if damping_s is None:
        damping_s = np.full(len(mean), np.inf)
    return _predict(mean, covariance, float(interval_s), float(acceleration_psd_m2_s3), damping_s)


@nb.njit(cache=True)
def _predict(mean, covariance, dt, psd, damping):
    n = len(mean)
    mean_out, covariance_out = np.empty((n, 4)), np.empty((n, 4, 4))
    for k in range(n):
        kept, reach = 1.0, dt  # speed left after dt, and way made per initial speed
        if np.isfinite(damping[k]):
            kept = np.exp(-dt / damping[k])
            reach = damping[k] * (1.0 - kept)
        for a in range(2):
            mean_out[k, a] = mean[k, a] + reach * mean[k, a + 2]
            mean_out[k, a + 2] = kept * mean[k, a + 2]
        for a in range(2):
            for b in range(2):
                pp, pv = covariance[k, a, b], covariance[k, a, b + 2]
                vp, vv = covariance[k, a + 2, b], covariance[k, a + 2, b + 2]
                covariance_out[k, a, b] = pp + reach * (pv + vp) + reach * reach * vv
                covariance_out[k, a, b + 2] = kept * (pv + reach * vv)
                covariance_out[k, a + 2, b] = kept * (vp + reach * vv)
                covariance_out[k, a + 2, b + 2] = kept * kept * vv
            covariance_out[k, a, a] += psd * dt**3 / 3
            covariance_out[k, a, a + 2] += psd * dt**2 / 2
            covariance_out[k, a + 2, a] += psd * dt**2 / 2
            covariance_out[k, a + 2, a + 2] += psd * dt
    return mean_out, covariance_out


@nb.njit(cache=True)
def update(mean, covariance, measured, measured_covariance):
    """States after each target has met its own measured position.

    Parameters
    ----------
    mean : (track, 4)
        Predicted mean. [m, m s⁻¹]
    covariance : (track, 4, 4)
        Predicted covariance.
    measured : (track, 2)
        East and north; a row of NaN leaves that target as it is. [m]
    measured_covariance : (track, 2, 2)
        Of the measured position. [m²]

    Returns
    -------
    Updated mean and covariance, new arrays; the covariance is symmetric by construction.
    """
    mean_out, covariance_out = mean.copy(), covariance.copy()
    gain = np.empty((4, 2))
    for k in range(len(mean)):
        if np.isnan(measured[k, 0]) or np.isnan(measured[k, 1]):
            continue
        s00 = covariance[k, 0, 0] + measured_covariance[k, 0, 0]
        s01 = covariance[k, 0, 1] + measured_covariance[k, 0, 1]
        s11 = covariance[k, 1, 1] + measured_covariance[k, 1, 1]
        determinant = s00 * s11 - s01 * s01
        for a in range(4):
            p0, p1 = covariance[k, a, 0], covariance[k, a, 1]
            gain[a, 0] = (p0 * s11 - p1 * s01) / determinant
            gain[a, 1] = (p1 * s00 - p0 * s01) / determinant
        y0, y1 = measured[k, 0] - mean[k, 0], measured[k, 1] - mean[k, 1]
        for a in range(4):
            mean_out[k, a] = mean[k, a] + gain[a, 0] * y0 + gain[a, 1] * y1
            for b in range(a + 1):
                left = (
                    covariance[k, a, b] - gain[a, 0] * covariance[k, 0, b] - gain[a, 1] * covariance[k, 1, b]
                )
                covariance_out[k, a, b] = left
                covariance_out[k, b, a] = left
    return mean_out, covariance_out
