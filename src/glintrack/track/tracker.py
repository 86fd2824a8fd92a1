"""The tracker: rectified frames and queried spectra in, tracks and the next queries out.

Its whole state is a frozen record of arrays; `step` returns a new one. Tracks are kept by log-likelihood
ratio and M of N, detections assigned one to one at least cost. It never sees the truth.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack import schema
from glintrack.records import SpectralQuery, Track
from glintrack.track import (
    belief,
    clutter,
    features,
    hypotheses,
    kinematics,
    modality,
    polarization,
    query,
)
from glintrack.track.background import Background, empty_background
from glintrack.track.blobs import Detections, no_detections, order, take
from glintrack.track.design import TrackDesign
from glintrack.track.frame import Grid, unpack, visible_fraction
from glintrack.track.roads import Roads, roads_of
from glintrack.track.targets import (
    Targets,
    hits_of,
    joined,
    kept,
    newborn,
    no_targets,
    select,
    unclaimed,
)

Array = np.ndarray
ColumnOf = Callable[[Float[Array, "target 3"]], Int[Array, "target"]]


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
    grid, backgrounds, clutter
        Of the frames, by product, and the density of false blobs [m⁻²]; None or empty before the first.
    targets, next_id
        All targets, confirmed or not, and the id the next one will get.
    population
        Of spectral features.
    detections
        Of the last frame, for pictures.
    choice
        The product of the frame in use; None before the first.
    polarized
        Population of polarization features.
    roads
        The road map, if there is one to use.
    motion
        Over the last interval; the next is mostly as long.
    ground
        Spectral features of the road.
    leaves
        What every target may be, with association by many hypotheses; `targets` are the best of them.
    """

    design: TrackDesign
    seed: int
    frame: int
    time_s: float
    interval_s: float
    grid: Grid | None
    backgrounds: Mapping[str, Background]
    clutter: Float[Array, "row column"] | None
    targets: Targets
    next_id: int
    population: features.Population
    detections: Detections
    choice: modality.Choice | None = None
    polarized: features.Population = features.empty_population(2)
    roads: Roads | None = None
    motion: kinematics.Motion | None = None
    ground: features.Population = features.empty_population(8)
    leaves: hypotheses.Leaves | None = None

    @property
    def background(self) -> Background:
        """Of the product in use."""
        name = self.choice.name if self.choice else "pan"
        return self.backgrounds.get(name) or next(iter(self.backgrounds.values()))


def start(
    design: TrackDesign | None = None, seed: int = 0, roads: Sequence[Float[Array, "point 2"]] | None = None
) -> TrackerState:
    """A tracker that has seen nothing.

    Parameters
    ----------
    design
        The default design if none is given.
    seed
        Of the random query policy, its only use of chance; each frame draws from (seed, frame).
    roads
        Centre lines of lanes (east, north) [m]; used if the design has ``road_prior``.

    Raises
    ------
    ValueError
        If the design wants roads and there are none.
    """
    design = TrackDesign() if design is None else design
    if design.road_prior and not roads:
        raise ValueError("`roads` must be given where the design has road_prior, got none")
    network = roads_of(roads) if design.road_prior and roads else None
    population = features.empty_population(design.feature_bins)
    none = no_targets(design)
    return TrackerState(
        design, int(seed), 0, -math.inf, 0.0, None, {}, None, none, 0, population, no_detections(),
        roads=network, ground=population,
        leaves=hypotheses.no_leaves(design) if design.association == "mht" else None,
    )  # fmt: skip


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
    _check_time(state, time_s)
    grid, frames = unpack(image, design, state.grid)
    interval_s = time_s - state.time_s if state.frame else 0.0
    known = state.backgrounds or {name: empty_background(grid.shape) for name in frames}

    motion = _motion_over(state, interval_s)
    predicted = _predicted(_believed(state), design, motion)
    on_map = predicted.confirmed & (predicted.unseen_s <= design.coast_s)
    if state.leaves is not None:  # what is but possible must not steer the search
        on_map &= state.leaves.chosen
    looks = modality.look(design, known, frames, grid, predicted.position[on_map], interval_s)
    choice = modality.choose(design, state.choice, looks, interval_s)
    found = looks[choice.name]
    # where there is no data a target cannot be seen, and a miss says nothing
    seen = visible_fraction(frames.get(choice.name, frames[design.products[0]]), grid, predicted.position)
    spectral, missed = _spectral_features(design, spectra, found.detections)
    if len(missed):
        state = replace(state, ground=belief.learnt_ground(state, missed))
    new, explained = _advanced(
        state,
        grid,
        time_s,
        motion,
        predicted,
        seen,
        found.detections,
        belief.told_of(state, spectral, _polarization(design, image, grid, found.detections)),
    )
    measured = new.targets.position[new.targets.confirmed & (new.targets.misses == 0)]
    learnt = modality.learn(
        design, known, looks, choice, explained, measured, interval_s or design.untracked_s
    )
    new = replace(new, backgrounds=learnt, choice=choice)
    return ask(new, column_of)


def step_detections(
    state: TrackerState,
    found: Detections,
    time_s: float,
    grid: Grid,
    features: Float[Array, "detection feature"] | None = None,
    ground: Float[Array, "spectrum feature"] | None = None,
) -> TrackerState:
    """One epoch of somebody else's detections, without an image.

    Parameters
    ----------
    state
        From `start` or the step before; not changed.
    found
        Detections of the epoch, in any order; none is fine.
    time_s
        Epoch, later than the last. [s]
    grid
        Area in which targets live, and in which the density of false detections is learnt.
    features
        Of each detection, as many as ``design.feature_bins``; a row of NaN for one that has none.
    ground
        Of spectra asked of the ground (`ask`).

    Raises
    ------
    ValueError
        If a detection is not finite, the features have another size, or time does not advance.
    """
    design = state.design
    _check_time(state, time_s)
    sequence = order(found)
    found = take(found, sequence)
    if ground is not None and len(ground):
        state = replace(state, ground=belief.learnt_ground(state, np.asarray(ground, float)))
    if features is None:
        features = np.full((len(found), design.feature_bins), np.nan)
    else:
        features = np.asarray(features, float)[sequence]
    if features.shape != (len(found), design.feature_bins):
        raise ValueError(
            f"`features` must have a row of {design.feature_bins} for each of {len(found)} detections, "
            f"got shape {features.shape}"
        )
    if not (np.isfinite(found.position).all() and np.isfinite(found.covariance).all()):
        raise ValueError("`found` must have finite positions and covariances, got some that are not")
    interval_s = time_s - state.time_s if state.frame else 0.0
    motion = _motion_over(state, interval_s)
    predicted = _predicted(_believed(state), design, motion)
    blind = np.full((len(found), 2), np.nan)  # no image, no polarization
    told = belief.told_of(state, features, blind)
    new, _ = _advanced(state, grid, time_s, motion, predicted, np.ones(len(predicted)), found, told)
    return new


def ask(state: TrackerState, column_of: ColumnOf | None) -> tuple[TrackerState, tuple[SpectralQuery, ...]]:
    """What to ask for in the next frame, expected one interval later; `step` does this itself.

    Parameters
    ----------
    state
        From `step_detections`.
    column_of
        As in `step`.

    Returns
    -------
    The state, which remembers who was asked, and the queries.
    """
    design = state.design
    if design.query_policy == "none" or column_of is None or state.interval_s == 0:
        return state, ()
    promising = hits_of(state.targets.history) >= 2
    motion = _motion_over(state, state.interval_s)
    targets = _predicted(select(state.targets, promising), design, motion)
    if design.query_policy == "random":
        priority = np.random.default_rng((state.seed, state.frame)).random(len(targets))
    elif design.query_policy == "round-robin":
        priority = targets.waited + 1.0
    else:
        detected = targets.mode_probability @ motion.detection
        priority = query.worth(targets, detected, state.population, design)
    spots = query.places(targets.position, targets.mean[:, 2:], design.query_reach_m)
    bare = np.empty((0, 2))
    if design.feature_mistaken:
        rng = np.random.default_rng((state.seed, state.frame, 1))
        most = min(query.MOST_GROUND, design.query_budget // query.GROUND_SHARE)
        bare = query.ground_points(targets, most, rng)
    queries = query.plan(spots, targets.id, priority, column_of, design.query_budget - len(bare))
    queries += tuple(SpectralQuery(float(east), float(north)) for east, north in bare)
    waited = state.targets.waited + 1
    waited[np.searchsorted(state.targets.id, [q.track_id for q in queries if q.track_id >= 0])] = 0
    return replace(state, targets=replace(state.targets, waited=waited)), queries


def _check_time(state: TrackerState, time_s: float) -> None:
    if not (math.isfinite(time_s) and time_s > state.time_s):
        raise ValueError(f"`time_s` must be later than the last frame's {state.time_s:g} s, got {time_s:g}")


def _advanced(
    state: TrackerState,
    grid: Grid,
    time_s: float,
    motion: kinematics.Motion,
    predicted: Targets,
    seen: Float[Array, "target"],
    found: Detections,
    told: belief.Told,
) -> tuple[TrackerState, Bool[Array, "detection"]]:
    """The state after an epoch's detections, and which of them a confirmed track explains."""
    design = state.design
    interval_s = time_s - state.time_s if state.frame else 0.0
    false_blobs = state.clutter
    if false_blobs is None:
        false_blobs = clutter.empty_map(grid, design.clutter_density_m2)
    density = clutter.density_at(false_blobs, grid, found.position, design.clutter_density_m2)
    leaves = state.leaves
    if leaves is None:
        targets, assigned, learnt = belief.advanced(
            state, motion, predicted, seen, found, density, told, interval_s
        )
    else:
        leaves, assigned, learnt = hypotheses.advanced(
            state, motion, predicted, seen, found, density, told, interval_s
        )
        targets = select(leaves.targets, leaves.chosen)
    explained = np.zeros(len(found), bool)
    explained[assigned[(assigned >= 0) & targets.confirmed]] = True
    targets = kept(design, targets, grid)
    fresh = (belief.without_ground(state, told), told.polarized)
    index = unclaimed(design, targets, found.position, assigned)
    born = newborn(design, found, fresh, index, state.next_id, state.roads)
    if leaves is not None:
        leaves = hypotheses.settled(leaves, targets, born, index, state.frame)
    targets = joined(targets, born)
    share = 1 - math.exp(-interval_s / design.clutter_s)
    new = TrackerState(
        design, state.seed, state.frame + 1, float(time_s), interval_s, grid, state.backgrounds,
        clutter.learn(false_blobs, grid, found.position, explained, share),
        targets, max(state.next_id, int(targets.id.max(initial=-1)) + 1), learnt[0], found,
        state.choice, learnt[1], state.roads, motion, state.ground, leaves,
    )  # fmt: skip
    return new, explained


def detections(state: TrackerState) -> Detections:
    """Blobs of the last frame that may be vehicles; ``.records()`` gives them one by one."""
    return state.detections


def report(state: TrackerState) -> xr.Dataset:
    """Confirmed tracks at the last epoch, as a Dataset of the schema ``tracks``."""
    targets = _reported(state)
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
    targets = _reported(state)
    return tuple(
        Track(
            track_id=int(targets.id[k]),
            time_s=state.time_s,
            east_m=float(targets.mean[k, 0]),
            north_m=float(targets.mean[k, 1]),
            east_speed_m_s=float(targets.mean[k, 2]),
            north_speed_m_s=float(targets.mean[k, 3]),
            east_var_m2=float(targets.covariance[k, 0, 0]),
            north_var_m2=float(targets.covariance[k, 1, 1]),
            status="coasted" if targets.misses[k] else "measured",
        )
        for k in range(len(targets))
    )


def _reported(state: TrackerState) -> Targets:
    shown = state.targets.confirmed
    if not state.design.report_coasted:
        shown = shown & (state.targets.misses == 0)
    return select(state.targets, shown)


def _motion_over(state: TrackerState, interval_s: float) -> kinematics.Motion:
    """Modes of motion over an interval; those of the last one serve again if it was as long."""
    if state.motion is not None and interval_s == state.interval_s:
        return state.motion
    return kinematics.motion_over(state.design, interval_s)


def _believed(state: TrackerState) -> Targets:
    """Everything that targets may be: themselves, or with many hypotheses all of them."""
    return state.targets if state.leaves is None else hypotheses.all_of(state.leaves, state.targets)


def _predicted(targets: Targets, design: TrackDesign, motion: kinematics.Motion) -> Targets:
    damped = (targets.misses > 0) & (motion.stopped < 0)  # where standing is a mode, nothing need be damped
    damping_s = np.where(damped, design.coast_damping_s, np.inf)
    return targets.moved(kinematics.predict(targets.modes, motion, damping_s, design.coast_sigma_m))


def _spectral_features(
    design: TrackDesign, spectra, found: Detections
) -> tuple[Float[Array, "detection feature"], Float[Array, "spectrum feature"]]:
    """Of each detection, NaN for none; and of the spectra asked of the ground."""
    if not isinstance(spectra, xr.Dataset) or spectra.sizes.get("query", 0) == 0:
        return np.full((len(found), design.feature_bins), np.nan), np.empty((0, design.feature_bins))
    kind = (design.feature_bins, design.feature_projection, design.feature_invariance)
    bare = spectra["track_id"].values < 0
    _, ground = features.of_spectra(spectra.isel(query=bare), *kind)
    where, values = features.of_spectra(spectra.isel(query=~bare), *kind)
    return features.attach(where, values, found.position, design.feature_radius_m), ground


def _polarization(
    design: TrackDesign, image: xr.Dataset, grid: Grid, found: Detections
) -> Float[Array, "detection 2"]:
    if not design.feature_polarization:
        return np.full((len(found), 2), np.nan)
    return polarization.of_detections(image, grid, found.position)
