"""The tracker: rectified frames and queried spectra in, tracks and the next queries out.

Its whole state is a frozen record of arrays; `step` returns a new one. Tracks are kept by log-likelihood
ratio and M of N, detections assigned one to one at least cost. It never sees the truth.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from glintrack import schema
from glintrack.records import SpectralQuery, Track
from glintrack.track import associate, change, features, kinematics, query
from glintrack.track.blobs import Detections, no_detections
from glintrack.track.design import TrackDesign

Array = np.ndarray
DOUBLE_SPEED_M_S = 3.0  # two tracks on one vehicle differ less
ColumnOf = Callable[[Float[Array, "target 3"]], Int[Array, "target"]]


@dataclass(frozen=True)
class Targets:
    """Everything known about each target, confirmed or not.

    Parameters
    ----------
    id
        Never reused.
    mean, covariance
        Kalman state ``[east, north, east speed, north speed]``. [m, m s⁻¹]
    born
        First position. [m]
    score
        Log-likelihood ratio of target against clutter. [nat]
    history
        One bit per past frame, the latest lowest; 1 where a detection was assigned.
    age_s
        Since the first detection. [s]
    unseen_s, misses
        Time and frames since a detection was assigned. [s]
    confirmed
        Reported.
    feature, spectra
        Mean spectral feature and number of spectra it comes from.
    entropy
        Of the last association. [nat]
    """

    id: Int[Array, "target"]
    mean: Float[Array, "target 4"]
    covariance: Float[Array, "target 4 4"]
    born: Float[Array, "target 2"]
    score: Float[Array, "target"]
    history: Int[Array, "target"]
    age_s: Float[Array, "target"]
    unseen_s: Float[Array, "target"]
    misses: Int[Array, "target"]
    confirmed: Bool[Array, "target"]
    feature: Float[Array, "target feature"]
    spectra: Float[Array, "target"]
    entropy: Float[Array, "target"]

    def __len__(self) -> int:
        """Count of targets."""
        return len(self.id)

    @property
    def position(self) -> Float[Array, "target 2"]:
        """East and north. [m]"""
        return self.mean[:, :2]


@dataclass(frozen=True)
class Grid:
    """The ground grid of the frames.

    Parameters
    ----------
    shape
        Rows and columns.
    corner_m
        East and north of the centre of pixel (0, 0). [m]
    gsd_m
        Spacing. [m]
    """

    shape: tuple[int, int]
    corner_m: tuple[float, float]
    gsd_m: float

    def pixel_of(self, position_m: Float[Array, "n 2"]) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
        """Row and column of the pixel nearest to each ground point, perhaps off the grid."""
        rows = np.rint((self.corner_m[1] - position_m[:, 1]) / self.gsd_m).astype(int)
        return rows, np.rint((position_m[:, 0] - self.corner_m[0]) / self.gsd_m).astype(int)


@dataclass(frozen=True)
class TrackerState:
    """What the tracker knows between two frames.

    Parameters
    ----------
    design, seed
        As given to `start`.
    frame
        Number of frames seen.
    time_s, interval_s
        Epoch of the last frame, and time between the last two (0 before the second). [s]
    grid, background
        Of the frames; None before the first.
    targets, next_id
        All targets, confirmed or not, and the id the next one will get.
    population
        Of spectral features.
    detections
        Of the last frame, for pictures.
    """

    design: TrackDesign
    seed: int
    frame: int
    time_s: float
    interval_s: float
    grid: Grid | None
    background: change.Background | None
    targets: Targets
    next_id: int
    population: features.Population
    detections: Detections


def start(design: TrackDesign | None = None, seed: int = 0) -> TrackerState:
    """A tracker that has seen nothing.

    Parameters
    ----------
    design
        The default design if none is given.
    seed
        Of the random query policy, its only use of chance; each frame draws from (seed, frame).
    """
    design = TrackDesign() if design is None else design
    size = design.feature_bins
    none = Targets(
        np.empty(0, np.int64), np.empty((0, 4)), np.empty((0, 4, 4)), np.empty((0, 2)), np.empty(0),
        np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty(0, np.int64), np.empty(0, bool),
        np.empty((0, size)), np.empty(0), np.empty(0),
    )  # fmt: skip
    population = features.empty_population(size)
    return TrackerState(
        design, int(seed), 0, -math.inf, 0.0, None, None, none, 0, population, no_detections()
    )


def step(
    state: TrackerState,
    image: xr.Dataset,
    spectra: xr.Dataset | tuple | None,
    time_s: float,
    column_of: ColumnOf | None = None,
) -> tuple[TrackerState, tuple[SpectralQuery, ...]]:
    """One frame: detect change, associate, update, and ask for the next frame's spectra.

    Parameters
    ----------
    state
        From `start` or the step before; not changed.
    image
        Dataset of the schema ``image`` on the same ground grid as before; NaN where there is no data.
    spectra
        Dataset of the schema ``spectra`` with what the sensor measured for the last queries; None or empty if
        there is none.
    time_s
        Epoch of the frame, later than the last. [s]
    column_of
        Superpixel column of ground points (n, 3), −1 off the array; None asks for no spectra.

    Returns
    -------
    The new state, and the queries for the next frame.

    Raises
    ------
    ValueError
        If the image breaks its schema, its grid has changed, or time does not advance.
    """
    design = state.design
    if not (math.isfinite(time_s) and time_s > state.time_s):
        raise ValueError(f"`time_s` must be later than the last frame's {state.time_s:g} s, got {time_s:g}")
    grid, values = _unpack(image, design, state.grid)
    interval_s = time_s - state.time_s if state.frame else 0.0
    background = state.background or change.empty_background(grid.shape)

    predicted = _predicted(state.targets, design, interval_s)
    on_map = predicted.confirmed & (predicted.unseen_s <= design.coast_s)
    found = change.detect(design, background, values, grid.gsd_m, grid.corner_m, predicted.position[on_map])
    spectral = _spectral_features(design, spectra, found.detections)

    assigned, targets = _associate(
        design, state.population, predicted, found.detections, spectral, values, grid
    )
    targets, population = _updated(
        design, targets, state.population, found.detections, spectral, assigned, interval_s
    )
    explained = np.zeros(len(found.detections), bool)
    explained[assigned[(assigned >= 0) & targets.confirmed]] = True
    targets = _kept(design, targets, grid)
    targets = _joined(targets, _newborn(design, targets, found.detections, spectral, assigned, state.next_id))
    new = TrackerState(
        design, state.seed, state.frame + 1, float(time_s), interval_s, grid,
        change.learn(design, background, found, explained, interval_s or design.untracked_s),
        targets, max(state.next_id, int(targets.id.max(initial=-1)) + 1), population, found.detections,
    )  # fmt: skip
    return new, _queries(new, column_of)


def detections(state: TrackerState) -> Detections:
    """Blobs of the last frame that may be vehicles; ``.records()`` gives them one by one."""
    return state.detections


def report(state: TrackerState) -> xr.Dataset:
    """Confirmed tracks at the last epoch, as a Dataset of the schema ``tracks``."""
    targets = _select(state.targets, state.targets.confirmed)
    columns = {
        "east": (targets.mean[:, 0], "m"),
        "north": (targets.mean[:, 1], "m"),
        "east_speed": (targets.mean[:, 2], "m s-1"),
        "north_speed": (targets.mean[:, 3], "m s-1"),
        "east_var": (targets.covariance[:, 0, 0], "m2"),
        "north_var": (targets.covariance[:, 1, 1], "m2"),
        "east_north_cov": (targets.covariance[:, 0, 1], "m2"),
        "coasted": ((targets.misses > 0).astype(float), "1"),
    }
    tracks = xr.Dataset(
        {name: ("track", values.copy(), {"units": units}) for name, (values, units) in columns.items()},
        coords={"track": targets.id.copy()},
        attrs={"time_s": state.time_s},
    )
    return schema.check(tracks, "tracks")


def tracks(state: TrackerState) -> tuple[Track, ...]:
    """The same tracks as small records."""
    targets = _select(state.targets, state.targets.confirmed)
    return tuple(
        Track(
            int(targets.id[k]), state.time_s, *targets.mean[k].tolist(),
            float(targets.covariance[k, 0, 0]), float(targets.covariance[k, 1, 1]),
            "coasted" if targets.misses[k] else "measured",
        )
        for k in range(len(targets))
    )  # fmt: skip


def _unpack(
    image: xr.Dataset, design: TrackDesign, expected: Grid | None
) -> tuple[Grid, Float[Array, "y x"]]:
    """Grid and plain array of the modality; the schema is checked on one row, the rest may be NaN anyway."""
    if not isinstance(image, xr.Dataset) or not {"y", "x"} <= set(image.coords):
        raise ValueError("`image` must be a Dataset with coordinates y and x [m], got none")
    schema.check(image.isel(y=slice(0, 1)), "image")
    for name, array in image.data_vars.items():
        frame = array.attrs.get("stokes_frame", "meridian")
        if frame != "meridian":
            raise ValueError(
                f"`image.{name}` must be in the meridian frame, got {frame!r} (rectify it first)"
            )
    y, x = image["y"].values, image["x"].values
    if len(y) < 2 or len(x) < 2:
        raise ValueError(f"`image` must have at least 2 × 2 pixels, got {len(y)} × {len(x)}")
    gsd_m = float(x[1] - x[0])
    # a hundredth of a pixel over the whole grid
    if not (
        gsd_m > 0
        and np.allclose(np.diff(x), gsd_m, atol=0.01 * gsd_m)
        and np.allclose(np.diff(y), -gsd_m, atol=0.01 * gsd_m)
    ):
        raise ValueError(
            f"`image` must be a square grid, x rising and y falling, "
            f"got steps {gsd_m:g} and {float(y[1] - y[0]):g} m"
        )
    grid = Grid((len(y), len(x)), (float(x[0]), float(y[0])), gsd_m)
    if expected is not None and grid.shape != expected.shape:
        raise ValueError(f"`image` must keep its size {expected.shape}, got {grid.shape}")
    if expected is not None and not np.allclose(
        (*grid.corner_m, grid.gsd_m), (*expected.corner_m, expected.gsd_m), atol=0.01 * gsd_m
    ):
        raise ValueError(
            f"`image` must keep its grid (corner {expected.corner_m}, GSD {expected.gsd_m:g} m), "
            f"got corner {grid.corner_m}, GSD {grid.gsd_m:g} m"
        )
    values = np.ascontiguousarray(image[design.modality].values, dtype=np.float32)
    if design.modality == "dolp":
        values = np.minimum(values * np.float32(design.dolp_boost), np.float32(1.0))  # NaN stays NaN
    return grid, values


def _predicted(targets: Targets, design: TrackDesign, interval_s: float) -> Targets:
    damping = np.where(targets.misses > 0, design.coast_damping_s, np.inf)
    mean, covariance = kinematics.predict(
        targets.mean, targets.covariance, interval_s, design.acceleration_psd_m2_s3, damping
    )
    return replace(targets, mean=mean, covariance=covariance)


def _spectral_features(design: TrackDesign, spectra, found: Detections) -> Float[Array, "detection feature"]:
    if not isinstance(spectra, xr.Dataset) or spectra.sizes.get("query", 0) == 0:
        return np.full((len(found), design.feature_bins), np.nan)
    where, values = features.of_spectra(spectra, design.feature_bins)
    return features.attach(where, values, found.position, design.feature_radius_m)


def _associate(design, population, targets, found, spectral, values, grid):
    """Detection of each target (−1 for none), and the targets with new score and entropy."""
    pairs, partners, surprise = associate.gate(
        targets.mean, targets.covariance, found.position, found.covariance, design.gate
    )
    cost = surprise + math.log(design.clutter_density_m2 / design.detection_probability)
    cost = cost - features.log_likelihood_ratio(
        population, targets.feature[pairs], targets.spectra[pairs], spectral[partners],
        design.feature_sigma, design.feature_cap,
    )  # fmt: skip
    # where there is no data a target cannot be seen, and a miss says nothing
    seen = _visible_fraction(values, grid, targets.position)
    miss_cost = -np.log1p(-design.detection_probability * seen)
    assigned = associate.assign(pairs, partners, cost, miss_cost, len(found))
    earned = -miss_cost
    chosen = assigned[pairs] == partners
    earned[pairs[chosen]] = -cost[chosen]
    entropy = query.association_entropy(pairs, cost, miss_cost)
    return assigned, replace(targets, score=targets.score + earned, entropy=entropy)


def _visible_fraction(values, grid: Grid, position_m: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Share of the 3 × 3 pixels about each point that have data; 0 off the grid."""
    rows, columns = grid.pixel_of(position_m)
    count = np.zeros(len(position_m))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y, x = rows + dy, columns + dx
            inside = (y >= 0) & (y < grid.shape[0]) & (x >= 0) & (x < grid.shape[1])
            count[inside] += np.isfinite(values[y[inside], x[inside]])
    return count / 9


def _updated(design, targets, population, found, spectral, assigned, interval_s):
    """Targets after their detections, and the population after their spectra."""
    hit = assigned >= 0
    measured, covariance = np.full((len(targets), 2), np.nan), np.zeros((len(targets), 2, 2))
    measured[hit], covariance[hit] = found.position[assigned[hit]], found.covariance[assigned[hit]]
    mean, state_covariance = kinematics.update(targets.mean, targets.covariance, measured, covariance)
    hits, window = _confirmation(design, interval_s)
    history = ((targets.history << 1) | hit) & ((1 << window) - 1)
    age_s = targets.age_s + interval_s

    feature, spectra = targets.feature.copy(), targets.spectra.copy()
    told = np.nonzero(hit)[0]
    told = told[np.isfinite(spectral[assigned[told]]).all(axis=1)]
    new = spectral[assigned[told]]
    population = features.learn(population, new, feature[told], spectra[told])
    spectra[told] += 1
    feature[told] += (new - feature[told]) / spectra[told, None]

    travel = np.hypot(*(mean[:, :2] - targets.born).T)
    speed = np.hypot(mean[:, 2], mean[:, 3])
    confirmed = targets.confirmed | (
        hit
        & (_hits(history) >= hits)
        & (age_s >= design.confirm_s - 1e-9)
        & (targets.score >= design.confirm_score)
        & (travel >= design.confirm_travel_m)
        & (speed >= design.confirm_speed_m_s)
    )
    updated = replace(
        targets, mean=mean, covariance=state_covariance, history=history, confirmed=confirmed,
        feature=feature, spectra=spectra, age_s=age_s,
        unseen_s=np.where(hit, 0.0, targets.unseen_s + interval_s),
        misses=np.where(hit, 0, targets.misses + 1),
    )  # fmt: skip
    return updated, population


def _confirmation(design: TrackDesign, interval_s: float) -> tuple[int, int]:
    """M and N of the confirmation at this frame rate."""
    fit = int(design.confirm_s / interval_s + 1e-6) + 1 if interval_s > 0 else 1
    window = min(max(design.confirm_window, fit), 32)
    return math.ceil(design.confirm_hits / design.confirm_window * window - 1e-9), window


def _hits(history: Int[Array, "target"]) -> Int[Array, "target"]:
    """Count the frames in a history that measured the target."""
    return ((history[:, None] >> np.arange(32)) & 1).sum(axis=1)


def _kept(design: TrackDesign, targets: Targets, grid: Grid) -> Targets:
    """Targets that live on: not lost, not off the grid, not a weaker double of another."""
    speed = np.hypot(targets.mean[:, 2], targets.mean[:, 3])
    # damping has slowed a coasting target: what counts is how fast it was when last measured
    last_speed = speed * np.exp(targets.unseen_s / design.coast_damping_s)
    patience = np.where(last_speed < design.stopped_speed_m_s, design.stopped_coast_s, design.coast_s)
    followed = targets.age_s - targets.unseen_s  # what was seen briefly is not believed for long
    alive = np.where(
        targets.confirmed,
        targets.unseen_s <= np.minimum(patience, followed) + 1e-9,
        (targets.misses <= design.tentative_misses) | (targets.unseen_s <= design.tentative_s + 1e-9),
    )
    rows, columns = grid.pixel_of(targets.position)
    alive &= (rows >= 0) & (rows < grid.shape[0]) & (columns >= 0) & (columns < grid.shape[1])
    return _select(targets, alive & ~_doubled(targets, alive, design.duplicate_m))


def _doubled(targets: Targets, alive: Bool[Array, "target"], distance_m: float) -> Bool[Array, "target"]:
    """Targets near a better one that moves alike; better is confirmed, then measured, then older."""
    out = np.zeros(len(targets), bool)
    index = np.nonzero(alive)[0]
    if len(index) < 2:
        return out
    index = index[np.lexsort((targets.id[index], targets.misses[index] > 0, ~targets.confirmed[index]))]
    pairs = cKDTree(targets.position[index]).query_pairs(distance_m, output_type="ndarray")
    for better, worse in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:  # index is sorted by rank
        a, b = index[better], index[worse]
        apart = np.hypot(*(targets.mean[a, 2:] - targets.mean[b, 2:]))
        if not out[a] and apart <= DOUBLE_SPEED_M_S:
            out[b] = True
    return out


def _newborn(design, targets, found, spectral, assigned, next_id) -> Targets:
    """A target for each detection that none took and that is no fragment of one taken."""
    free = np.ones(len(found), bool)
    free[assigned[assigned >= 0]] = False
    here = targets.position[targets.misses == 0]
    if len(here) and free.any():
        nearest, _ = cKDTree(here).query(found.position)
        free &= nearest > design.duplicate_m
    index = np.nonzero(free)[0]
    n, size = len(index), design.feature_bins
    mean = np.zeros((n, 4))
    mean[:, :2] = found.position[index]
    covariance = np.zeros((n, 4, 4))
    covariance[:, :2, :2] = found.covariance[index]
    covariance[:, 2, 2] = covariance[:, 3, 3] = design.speed_sigma_m_s**2
    told = np.isfinite(spectral[index]).all(axis=1)
    return Targets(
        np.arange(next_id, next_id + n), mean, covariance, found.position[index].copy(), np.zeros(n),
        np.ones(n, np.int64), np.zeros(n), np.zeros(n), np.zeros(n, np.int64), np.zeros(n, bool),
        np.where(told[:, None], spectral[index], 0.0).reshape(n, size), told.astype(float), np.zeros(n),
    )  # fmt: skip


def _queries(state: TrackerState, column_of: ColumnOf | None) -> tuple[SpectralQuery, ...]:
    """What to ask for in the next frame, expected one interval later."""
    design = state.design
    if design.query_policy == "none" or column_of is None or state.interval_s == 0:
        return ()
    promising = _hits(state.targets.history) >= 2
    targets = _predicted(_select(state.targets, promising), design, state.interval_s)
    if design.query_policy == "random":
        priority = np.random.default_rng((state.seed, state.frame)).random(len(targets))
    else:
        priority = query.gain(targets.entropy, targets.spectra, targets.misses > 0)
    return query.plan(targets.position, targets.id, priority, column_of, design.query_budget)


def _select(targets: Targets, index: np.ndarray) -> Targets:
    return Targets(*(getattr(targets, f.name)[index] for f in fields(Targets)))


def _joined(a: Targets, b: Targets) -> Targets:
    return Targets(*(np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in fields(Targets)))
