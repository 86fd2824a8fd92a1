"""Evidence of identity in a vehicle's spectrum.

A spectrum is reduced to the logarithms of a few bin means, less their own mean, since shade scales a
spectrum. Two covariances are estimated during the run: that of all spectra and that of one track's spectra. A
new spectrum counts for a track by the logarithm of its likelihood ratio between them.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.linalg import lapack, solve_triangular

from glintrack.core import schema
from glintrack.core.arrays import Array

ATTACH_RADIUS_M = 1.5  # from the queried point to the nearest detection, to which the spectrum belongs
PRIOR_SPECTRA = 20.0  # weight of `WITHIN_SPREAD` against what one track's spectra show
WITHIN_SPREAD = 0.35  # prior spread of one vehicle's spectra relative to that of all vehicles'
RIDGE = 1e-4  # least variance of a measured log radiance (1 %)
BINS = 8  # spectral bins, which are the features
MAX_RATIO_NAT = 6.0  # limit of the features' log-likelihood ratio


@dataclass(frozen=True)
class Population:
    """Running moments of the features of all spectra, and of their spread within one track.

    Parameters
    ----------
    count, mean, scatter
        Number, mean and sum of squared deviations of all features.
    within_count, within_scatter
        Degrees of freedom and sum of squared deviations from the tracks' own means.
    """

    count: float
    mean: Float[Array, "feature"]
    scatter: Float[Array, "feature feature"]
    within_count: float
    within_scatter: Float[Array, "feature feature"]


def empty_population(size: int) -> Population:
    """Return a population without a spectrum."""
    return Population(0.0, np.zeros(size), np.zeros((size, size)), 0.0, np.zeros((size, size)))


def spectral_features(
    spectra: xr.Dataset, bins: int
) -> tuple[Float[Array, "query 2"], Float[Array, "query bin"]]:
    """Compute ground points and features of the served queries.

    Parameters
    ----------
    spectra
        Dataset of the schema ``spectra``.
    bins
        Number of bins; a spectrum with fewer wavelengths than that gives one feature each, rest 0.

    Returns
    -------
    East and north [m], and features: logarithms of means over bins of wavelength, less their mean, which is
    illumination [nat]. Spectra without positive radiance are left out.
    """
    schema.check(spectra, "spectra")
    served = spectra["served"].values
    radiance = np.asarray(spectra["radiance"].values, dtype=float)
    noise = np.asarray(spectra["noise"].values, dtype=float)
    used = min(bins, radiance.shape[1])
    logarithm = np.zeros((len(radiance), used))
    for k, band in enumerate(np.array_split(np.arange(radiance.shape[1]), used)):
        total = radiance[:, band].sum(axis=1)
        sigma = np.sqrt((noise[:, band] ** 2).sum(axis=1))  # below its noise a bin has no logarithm
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm[:, k] = np.log(np.maximum(total, sigma) / len(band))
    valid = served & np.isfinite(logarithm).all(axis=1)
    features = np.zeros((int(valid.sum()), bins))
    features[:, :used] = logarithm[valid] - logarithm[valid].mean(axis=1, keepdims=True)
    position = np.stack([spectra["east_m"].values, spectra["north_m"].values], axis=-1).astype(float)
    return position[valid], features


def attach(
    query_m: Float[Array, "query 2"],
    features: Float[Array, "query feature"],
    detection_m: Float[Array, "detection 2"],
    radius_m: float,
) -> Float[Array, "detection feature"]:
    """Attach to each detection the feature of the nearest spectrum within the radius, NaN for none."""
    out = np.full((len(detection_m), features.shape[1]), np.nan)
    if len(query_m) and len(detection_m):
        distance = np.hypot(*(query_m[:, None] - detection_m[None]).transpose(2, 0, 1))
        nearest_detection = distance.argmin(axis=1)
        reach = distance[np.arange(len(query_m)), nearest_detection]
        for q in np.argsort(-reach, kind="stable"):  # the nearest is written last
            if reach[q] <= radius_m:
                out[nearest_detection[q]] = features[q]
    return out


def log_likelihood_ratio(
    population: Population,
    track_mean: Float[Array, "pair feature"],
    track_count: Float[Array, "pair"],
    feature: Float[Array, "pair feature"],
) -> Float[Array, "pair"]:
    """Log-likelihood ratio of the pair's track against any vehicle, clipped; 0 without data. [nat]

    Parameters
    ----------
    population
        Spectra so far; with fewer than two per feature the ratio is 0.
    track_mean, track_count
        Mean feature of each pair's track, and its number of spectra.
    feature
        Feature of each pair's detection, NaN for none.
    """
    if not is_informative(population) or len(feature) == 0:
        return np.zeros(len(feature))
    ratio, basis = axes(population)
    own, variance = next_spectrum((track_mean - population.mean) @ basis, track_count, ratio)
    along = (feature - population.mean) @ basis
    total = 0.5 * (along**2 - (along - own) ** 2 / variance - np.log(variance)).sum(axis=1)
    valid = (track_count > 0) & np.isfinite(total)
    return np.where(valid, np.clip(total, -MAX_RATIO_NAT, MAX_RATIO_NAT), 0.0)


def next_spectrum(
    mean: Float[Array, "track axis"], count: Float[Array, "track"], ratio: Float[Array, "axis"]
) -> tuple[Float[Array, "track axis"], Float[Array, "track axis"]]:
    """Mean and variance of a track's next spectrum along the axes, where all have mean 0 and variance 1.

    Bayes: the prior variance of the vehicle's own mean is 1 − ratio, and that of its spectra is the ratio.

    Parameters
    ----------
    mean, count
        Mean spectrum of each track along the axes, and the number of its spectra.
    ratio
        Spread within one track over that of all (`axes`).
    """
    count = np.asarray(count, float)[:, None]
    gain = count * (1 - ratio) / (count * (1 - ratio) + ratio)
    return gain * mean, ratio + (1 - ratio) * (1 - gain)


def ground_ratio(
    population: Population, ground: Population, feature: Float[Array, "spectrum feature"]
) -> Float[Array, "spectrum"]:
    """Log-likelihood ratio of ground against vehicle of each feature, clipped; 0 for NaN. [nat]

    Parameters
    ----------
    population, ground
        Spectra of vehicles, and of the ground; with fewer than two per feature in either the ratio is 0.
    feature
        Feature of each spectrum.
    """
    out = np.zeros(len(feature))
    valid = np.isfinite(feature).all(axis=1)
    if not (is_informative(population) and is_informative(ground)) or not valid.any():
        return out
    of_ground, of_vehicle = (_log_density(one, feature[valid]) for one in (ground, population))
    out[valid] = np.clip(of_ground - of_vehicle, -MAX_RATIO_NAT, MAX_RATIO_NAT)
    return out


def _log_density(population: Population, feature: Float[Array, "n feature"]) -> Float[Array, "n"]:
    """Gaussian log density of each feature, up to a constant. [nat]"""
    spread = population.scatter / population.count + RIDGE * np.eye(len(population.mean))
    low = np.linalg.cholesky(spread)
    white = solve_triangular(low, (feature - population.mean).T, lower=True)
    return -0.5 * (white**2).sum(axis=0) - np.log(np.diag(low)).sum()


def outlier_mixture(
    ratio: Float[Array, "pair"], ground: Float[Array, "pair"], outlier_share: float
) -> tuple[Float[Array, "pair"], Float[Array, "pair"]]:
    """Log-likelihood ratio where a share of the spectra does not show the vehicle's paint.

    Half of these show the ground next to it, the others anything: glass, glint, another vehicle.

    Parameters
    ----------
    ratio
        Ratio of the track against any vehicle, if the spectrum is a vehicle's. [nat]
    ground
        From `ground_ratio`. [nat]
    outlier_share
        Share of spectra that show something else. [1]

    Returns
    -------
    The ratio [nat], and the probability that the spectrum is the track's own if the track is there [1].
    """
    own = (1 - outlier_share) * np.exp(ratio)
    other = 0.5 * outlier_share * (np.exp(ground) + 1)
    return np.log((own + other) / (1 - outlier_share + other)), own / (own + other)


def divergence2(
    one: tuple[Float[Array, "pair axis"], Float[Array, "pair"]],
    other: tuple[Float[Array, "pair axis"], Float[Array, "pair"]],
    ratio: Float[Array, "axis"],
) -> Float[Array, "pair"]:
    """Twice the divergence (Kullback and Leibler) of one track's next spectrum from another's, capped. [1]

    Parameters
    ----------
    one, other
        Mean spectra along the axes (`along_axes`), and the numbers of spectra.
    ratio
        Spread within one track over that of all (`axes`).
    """
    (a, a_variance), (b, b_variance) = (next_spectrum(mean, count, ratio) for mean, count in (one, other))
    wider = a_variance / b_variance
    return np.minimum(((a - b) ** 2 / b_variance + wider - 1 - np.log(wider)).sum(axis=1), 2 * MAX_RATIO_NAT)


def is_informative(population: Population) -> bool:
    """Return True if a population holds enough spectra to compare others with."""
    return population.count >= 2 * len(population.mean)


def along_axes(
    population: Population, mean: Float[Array, "track feature"], count: Float[Array, "track"]
) -> tuple[Float[Array, "track feature"], Float[Array, "axis"]]:
    """Mean features of tracks along the `axes`, and the spread along those; of length 0 without axes.

    Parameters
    ----------
    population
        Spectra so far.
    mean, count
        Mean feature of each track, and its number of spectra.
    """
    along = np.zeros_like(mean)
    if not is_informative(population):
        return along, np.empty(0)
    valid = np.flatnonzero(count > 0)  # few of many
    ratio, basis = axes(population)
    along[valid] = (mean[valid] - population.mean) @ basis
    return along, ratio


def axes(population: Population) -> tuple[Float[Array, "feature"], Float[Array, "feature feature"]]:
    """Spread within one track over that of all, in the axes that make the latter 1; and those axes.

    The population must be informative (`is_informative`).
    """
    size = len(population.mean)
    all_spread = population.scatter / population.count + RIDGE * np.eye(size)
    within = (PRIOR_SPECTRA * WITHIN_SPREAD**2 * all_spread + population.within_scatter) / (
        PRIOR_SPECTRA + population.within_count
    ) + RIDGE * np.eye(size)  # an axis without variance carries no evidence
    # the basis makes all_spread 1 and within diagonal; both are finite and all_spread positive by its ridge
    ratio, basis, failed = lapack.dsygvd(within, all_spread)  # pyright: ignore[reportAttributeAccessIssue]
    if failed:
        raise np.linalg.LinAlgError(f"spectral features have no axes: LAPACK's dsygvd returned {failed}")
    return np.minimum(np.maximum(ratio, 1e-3), 1.0), np.ascontiguousarray(basis)


def update_population(
    population: Population,
    features: Float[Array, "spectrum feature"],
    track_mean: Float[Array, "spectrum feature"],
    track_count: Float[Array, "spectrum"],
) -> Population:
    """Update a population with more spectra, each with the mean and count of its track before it.

    References
    ----------
    Chan, Golub and LeVeque, The American Statistician 37, 242 (1983): moments of two sets joined.
    """
    if len(features) == 0:
        return population
    features, n = np.asarray(features, float), len(features)
    middle = features.mean(axis=0)
    delta, about = middle - population.mean, features - middle
    total = population.count + n
    scatter = about.T @ about + np.outer(delta, delta) * population.count * n / total
    known = track_count > 0
    weight = track_count[known] / (track_count[known] + 1.0)
    own = features[known] - track_mean[known]
    return Population(
        count=total, mean=population.mean + delta * n / total, scatter=population.scatter + scatter,
        within_count=population.within_count + int(known.sum()),
        within_scatter=population.within_scatter + (own * weight[:, None]).T @ own,
    )  # fmt: skip
