"""Evidence of identity in a vehicle's spectrum.

A spectrum is reduced to the logarithms of a few bin means, less their own mean: shade, which scales the
spectrum, then takes away little. Two covariances are learnt as the run goes, that of all spectra and that of
one track's spectra; a new spectrum counts for a track by the logarithm of its likelihood ratio between them.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.linalg import lapack

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.track.identity import feature_kernels as kernels

PRIOR_SPECTRA = 20.0  # weight of the design's spread against what one track's spectra show
RIDGE = 1e-4  # variance of a log radiance nobody can measure better than (1 %)


@dataclass(frozen=True)
class Population:
    """Running moments of the features of all spectra, and of their spread within one track.

    Parameters
    ----------
    count, mean, scatter
        Number, mean and sum of squared deviations of all features.
    within_count, within_scatter
        Degrees of freedom and sum of squared deviations from the tracks' own means.
    angle2, within_angle2
        Sums of the squared spectral angle to the mean of all and to the tracks' own means. [rad²]
    """

    count: float
    mean: Float[Array, "feature"]
    scatter: Float[Array, "feature feature"]
    within_count: float
    within_scatter: Float[Array, "feature feature"]
    angle2: float = 0.0
    within_angle2: float = 0.0


def empty_population(size: int) -> Population:
    """No spectrum seen yet."""
    return Population(0.0, np.zeros(size), np.zeros((size, size)), 0.0, np.zeros((size, size)))


def of_spectra(spectra: xr.Dataset, bins: int) -> tuple[Float[Array, "query 2"], Float[Array, "query bin"]]:
    """Ground points and features of the queries that were served.

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
    served = spectra["served"].values > 0
    radiance = np.asarray(spectra["radiance"].values, dtype=float)
    noise = np.asarray(spectra["noise"].values, dtype=float)
    used = min(bins, radiance.shape[1])
    logarithm = np.zeros((len(radiance), used))
    for k, band in enumerate(np.array_split(np.arange(radiance.shape[1]), used)):
        total = radiance[:, band].sum(axis=1)
        sigma = np.sqrt((noise[:, band] ** 2).sum(axis=1))  # below its noise a bin has no logarithm
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm[:, k] = np.log(np.maximum(total, sigma) / len(band))
    kept = served & np.isfinite(logarithm).all(axis=1)
    features = np.zeros((int(kept.sum()), bins))
    features[:, :used] = logarithm[kept] - logarithm[kept].mean(axis=1, keepdims=True)
    position = np.stack([spectra["east"].values, spectra["north"].values], axis=-1).astype(float)
    return position[kept], features


def attach(
    query_m: Float[Array, "query 2"],
    features: Float[Array, "query feature"],
    detection_m: Float[Array, "detection 2"],
    radius_m: float,
) -> Float[Array, "detection feature"]:
    """Feature of each detection: that of the nearest spectrum within the radius, NaN for none."""
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
    sigma: float,
    cap: float,
    known: tuple[Array, Array] | None = None,
) -> Float[Array, "pair"]:
    """How much more a feature speaks for a track than for anybody, clipped; 0 where either is missing. [nat]

    Parameters
    ----------
    population
        Learnt so far; while it holds fewer than two spectra per feature nothing is said.
    track_mean, track_count
        Mean feature of the track of each pair, and of how many spectra.
    feature
        Of the detection of each pair, NaN for none.
    sigma
        Prior spread of one track's spectra relative to that of all. [1]
    cap
        Greatest magnitude. [nat]
    known
        `axes` of the population and sigma, if they were worked out before.
    """
    if not speaks(population) or len(feature) == 0:
        return np.zeros(len(feature))
    ratio, basis = axes(population, sigma) if known is None else known
    return kernels.log_ratios(
        feature, track_mean, np.asarray(track_count, float), population.mean, basis, ratio, cap
    )


def ground_ratio(
    population: Population, ground: Population, feature: Float[Array, "spectrum feature"], cap: float
) -> Float[Array, "spectrum"]:
    """How much more each feature speaks for the ground than for a vehicle, clipped; 0 for NaN. [nat]

    Parameters
    ----------
    population, ground
        Spectra of vehicles, and of the ground; while either holds fewer than two spectra per
        feature nothing is said.
    feature
        Of each spectrum.
    cap
        Greatest magnitude. [nat]
    """
    out = np.zeros(len(feature))
    valid = np.isfinite(feature).all(axis=1)
    if not (speaks(population) and speaks(ground)) or not valid.any():
        return out
    with_feature = feature[valid]
    of_ground, of_vehicle = (
        kernels.log_densities(with_feature, one.mean, one.scatter / one.count + RIDGE * np.eye(len(one.mean)))
        for one in (ground, population)
    )
    out[valid] = np.clip(of_ground - of_vehicle, -cap, cap)
    return out


def outlier_mixture(
    ratio: Float[Array, "pair"], ground: Float[Array, "pair"], outlier_share: float
) -> tuple[Float[Array, "pair"], Float[Array, "pair"]]:
    """The same log-likelihood ratio where a share of the spectra does not show the vehicle's paint.

    Half of these show the ground beside it, the others anything: glass, glint, a neighbour.

    Parameters
    ----------
    ratio
        Of track against anybody, if the spectrum is a vehicle's. [nat]
    ground
        From `ground_ratio`. [nat]
    mistaken
        Share of spectra that show something else. [1]

    Returns
    -------
    The ratio [nat], and the probability that the spectrum is the track's own if the track is there [1].
    """
    return kernels.outlier_mixture(ratio, ground, outlier_share)


def separation2(
    population: Population,
    one: Float[Array, "pair feature"],
    one_count: Float[Array, "pair"],
    other: Float[Array, "pair feature"],
    other_count: Float[Array, "pair"],
    sigma: float,
    cap: float,
) -> Float[Array, "pair"]:
    """How far apart two tracks' spectra are: twice the log-likelihood ratio to expect of one more. [1]

    Parameters
    ----------
    population
        Learnt so far; while it holds fewer than two spectra per feature nothing is apart.
    one, one_count, other, other_count
        Mean features of two tracks and the number of their spectra; a track without one is anybody.
    sigma, cap
        As in `log_likelihood_ratio`.

    Returns
    -------
    Twice the divergence (Kullback and Leibler) of the first track's next spectrum from the second's.
    """
    if not speaks(population) or len(one) == 0:
        return np.zeros(len(one))
    ratio, basis = axes(population, sigma)
    a, b = (one - population.mean) @ basis, (other - population.mean) @ basis
    counts = np.asarray(one_count, float), np.asarray(other_count, float)
    return kernels.divergences2(a, counts[0], b, counts[1], ratio, cap)


def speaks(population: Population) -> bool:
    """Whether enough spectra were seen to say anything."""
    return population.count >= 2 * len(population.mean)


def along_axes(
    population: Population, mean: Float[Array, "track feature"], count: Float[Array, "track"], sigma: float
) -> tuple[Float[Array, "track feature"], Float[Array, "axis"]]:
    """Tracks' mean features along the `axes`, and the spread along those; of length 0 while nothing is said.

    Parameters
    ----------
    population
        Learnt so far.
    mean, count
        Mean feature of each track, and of how many spectra.
    sigma
        As in `log_likelihood_ratio`.
    """
    along = np.zeros_like(mean)
    if not speaks(population):
        return along, np.empty(0)
    valid = np.flatnonzero(count > 0)  # few of many
    ratio, basis = axes(population, sigma)
    along[valid] = (mean[valid] - population.mean) @ basis
    return along, ratio


def axes(
    population: Population, sigma: float
) -> tuple[Float[Array, "feature"], Float[Array, "feature feature"]]:
    """Spread within one track over that of all, in the axes that make the latter 1; and those axes.

    Parameters
    ----------
    population
        That `speaks`.
    sigma
        As in `log_likelihood_ratio`.
    """
    size = len(population.mean)
    all_spread = population.scatter / population.count + RIDGE * np.eye(size)
    within = (PRIOR_SPECTRA * sigma**2 * all_spread + population.within_scatter) / (
        PRIOR_SPECTRA + population.within_count
    )
    # the basis makes all_spread 1 and within diagonal; both are finite and all_spread positive by its ridge
    ratio, basis, failed = lapack.dsygvd(within, all_spread)  # pyright: ignore[reportAttributeAccessIssue]
    if failed:
        raise np.linalg.LinAlgError(f"spectral features have no axes: LAPACK's dsygvd returned {failed}")
    return np.minimum(np.maximum(ratio, 1e-3), 1.0), np.ascontiguousarray(basis)


def spectral_angle(a: Float[Array, "pair feature"], b: Float[Array, "pair feature"]) -> Float[Array, "pair"]:
    """Spectral angle (Kruse et al., Remote Sens. Environ. 44, 145, 1993) of two log spectra. [rad]

    It does not change when a spectrum is scaled, which in the logarithm is a constant added.
    """
    return kernels.angles(np.asarray(a, float), np.asarray(b, float))


def angle_likelihood_ratio(
    population: Population,
    track_mean: Float[Array, "pair feature"],
    track_count: Float[Array, "pair"],
    feature: Float[Array, "pair feature"],
    sigma: float,
    cap: float,
    known: tuple[Array, Array] | None = None,
) -> Float[Array, "pair"]:
    """The same as `log_likelihood_ratio`, from nothing but the spectral angle between track and detection.

    The angle counts as half-normal, of one spread for two spectra of one vehicle and a wider one for two
    vehicles; both are learnt. Axes, if known, are not needed.
    """
    out = np.zeros(len(feature))
    valid = (track_count > 0) & np.isfinite(feature).all(axis=1)
    if not speaks(population) or not valid.any():
        return out
    anybody = 2 * population.angle2 / population.count + RIDGE  # two vehicles differ, each from the mean
    own = (PRIOR_SPECTRA * sigma**2 * anybody + population.within_angle2) / (
        PRIOR_SPECTRA + population.within_count
    )
    own = min(max(own, 1e-3 * anybody), anybody)
    angle2 = spectral_angle(feature[valid], track_mean[valid]) ** 2
    ratio = 0.5 * np.log(anybody / own) - 0.5 * angle2 * (1 / own - 1 / anybody)
    out[valid] = np.clip(ratio, -cap, cap)
    return out


def update_population(
    population: Population,
    features: Float[Array, "spectrum feature"],
    track_mean: Float[Array, "spectrum feature"],
    track_count: Float[Array, "spectrum"],
) -> Population:
    """The population after some more spectra, each with the mean and count of its track before it.

    References
    ----------
    Chan, Golub and LeVeque, The American Statistician 37, 242 (1983): moments of two sets joined.
    """
    if len(features) == 0:
        return population
    features, track_mean = np.asarray(features, float), np.asarray(track_mean, float)
    mean, scatter, angle2 = kernels.joined_moments(
        population.count, population.mean, population.scatter, features
    )
    within_scatter, known, own_angle2 = kernels.own_moments(
        population.within_scatter, features, track_mean, np.asarray(track_count, float)
    )
    return Population(
        population.count + len(features),
        mean,
        scatter,
        population.within_count + known,
        within_scatter,
        population.angle2 + angle2,
        population.within_angle2 + own_angle2,
    )
