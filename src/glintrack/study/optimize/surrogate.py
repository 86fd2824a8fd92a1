"""Gaussian process of a score over designs, with an effect of each city and fitted noise.

The score of design x in city c with duration t is

y = μ + g(x, t) + u(c) + e,

with a Matérn 5/2 covariance of g, one variance for the effects u of cities, and noise e with a variance
inversely proportional to the duration, as that of a mean over time. μ has a wide normal distribution: the
level is as uncertain as a mean over the few cities. The hyperparameters maximize the marginal likelihood
(scikit-learn). `predict` gives the posterior of μ + g at the full duration: the mean over all cities.

References
----------
Rasmussen and Williams, Gaussian Processes for Machine Learning (MIT Press, 2006), Eqs. (2.25), (2.26),
(2.40) and (5.8).
"""

import math
import warnings
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg
from scipy.spatial.distance import cdist

from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra

_ANY = 1e6  # length scale of a coordinate without effect
_MEAN = 100.0  # variance of μ before the first score, over that of the scores
_LENGTHS = (0.15, 20.0)  # in ranges of an axis
_DURATION_LENGTHS = (1.0, 50.0)  # in halvings of the duration
_SIGNAL, _CITY, _NOISE = (0.03, 30.0), (0.02, 5.0), (0.01, 5.0)  # over the variance of the scores


@dataclass(frozen=True)
class GaussianProcess:
    """Fitted Gaussian process.

    Parameters
    ----------
    inputs
        Places of the designs, and as last column the halvings of the duration: 0 for the full one.
    lengths
        Length scale of each column.
    signal_variance, mean_variance
        Variances of g and of μ.
    mean
        Mean of the scores, about which μ varies; of logarithms with half their variance, for the logarithm of
        the mean.
    weights, inverse
        K⁻¹(y − ``mean``), and K⁻¹, with the covariance K of the scores.
    city_sd, noise_sd
        Standard deviation of the effects of cities, and of the noise at the full duration.
    """

    inputs: Float[Array, "n column"]
    lengths: Float[Array, "column"]
    signal_variance: float
    mean_variance: float
    mean: float
    weights: Float[Array, "n"]
    inverse: Float[Array, "n n"]
    city_sd: float
    noise_sd: float

    def predict(self, places: Float[Array, "m axis"]) -> tuple[Float[Array, "m"], Float[Array, "m"]]:
        """Posterior mean and standard deviation of the score's mean over cities at the full duration."""
        at = np.column_stack([places, np.zeros(len(places))])
        alike = matern(cdist(at / self.lengths, self.inputs / self.lengths))
        cross = self.mean_variance + self.signal_variance * alike
        known = np.einsum("mi,ij,mj->m", cross, self.inverse, cross)
        variance = self.mean_variance + self.signal_variance - known
        return self.mean + cross @ self.weights, np.sqrt(np.maximum(variance, 0.0))

    def to_values(self) -> dict[str, Any]:
        """Plain values, for a page's program."""
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(self).items()}


def matern(distance: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """Matérn 5/2 correlation at a distance in length scales."""
    r = math.sqrt(5) * distance
    return (1 + r + r**2 / 3) * np.exp(-r)


def fit_gaussian_process(
    places: Float[Array, "n axis"],
    cities: Int[Array, "n"],
    halvings: Float[Array, "n"],
    scores: Float[Array, "n"],
) -> GaussianProcess:
    """Fit mean, hyperparameters and weights.

    Parameters
    ----------
    places
        Encoded designs, about 0 to 1 along each axis.
    cities
        Number of each score's city.
    halvings
        log₂ of the full duration over that of the simulation: 0 for the full one.
    scores
        Finite scores.

    Raises
    ------
    MissingExtraError
        Without scikit-learn.
    """
    process = require_extra("sklearn.gaussian_process", "optimize", "search for a design")
    kernels = require_extra("sklearn.gaussian_process.kernels", "optimize", "search for a design")
    count, axes = places.shape
    mean = float(scores.mean())
    scale = max(float(scores.std()), 1e-9 * max(abs(mean), 1.0))
    fixed = (_ANY, _ANY * (1 + 1e-6))
    of_design = kernels.Matern(
        [0.7] * axes + [4.0, _ANY], [_LENGTHS] * axes + [_DURATION_LENGTHS, fixed], nu=2.5
    )
    of_city = kernels.RBF([_ANY] * (axes + 1) + [0.01], "fixed")
    kernel = (
        kernels.ConstantKernel(1.0, _SIGNAL) * of_design
        + kernels.ConstantKernel(0.2, _CITY) * of_city
        + _duration_noise(kernels)(0.2, _NOISE)
        + kernels.ConstantKernel(_MEAN, "fixed")
    )
    columns = np.column_stack([places, halvings, cities]).astype(float)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of hyperparameters at their bounds
        fitted = process.GaussianProcessRegressor(kernel).fit(columns, (scores - mean) / scale)
    found = fitted.kernel_.get_params()
    inverse = linalg.cho_solve((fitted.L_, True), np.eye(count)) / scale**2
    return GaussianProcess(
        inputs=columns[:, :-1],
        lengths=np.array(found["k1__k1__k1__k2__length_scale"][:-1], float),
        signal_variance=scale**2 * found["k1__k1__k1__k1__constant_value"],
        mean_variance=scale**2 * _MEAN,
        mean=mean,
        weights=inverse @ (scores - mean),
        inverse=inverse,
        city_sd=scale * math.sqrt(found["k1__k1__k2__k1__constant_value"]),
        noise_sd=scale * math.sqrt(found["k1__k2__noise_level"]),
    )


def _duration_noise(kernels: Any) -> Any:
    """Class of scikit-learn's white noise with twice the variance for each halving of the duration."""

    class DurationNoise(kernels.WhiteKernel):
        """White noise times two to the power of the last column but one."""

        def __call__(self, X, Y=None, eval_gradient=False):
            """Covariance of the noise, and its gradient."""
            factor = 2.0 ** X[:, -2:-1]
            if eval_gradient:
                found, gradient = super().__call__(X, Y, True)
                return factor * found, factor[..., None] * gradient
            return factor * super().__call__(X, Y)

        def diag(self, X):
            """Variance of the noise of each row."""
            return 2.0 ** X[:, -2] * super().diag(X)

    return DurationNoise
