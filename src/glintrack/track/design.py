"""Design of the tracker: the ``[track]`` table of a case, with one table for each part.

All times are in seconds, so that they mean the same at any frame rate.
"""

import math
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from glintrack.core.designs import Design, refuse_ignored
from glintrack.core.installation import read_data
from glintrack.track.calibration import read_calibration

# Initiation with existence reporting: generous, since reporting decides.
EXISTENCE_INITIATION = {"rules": "existence", "confirm_score": 2.0}
_CONFIRMATION_KEYS = (
    "rules", "confirm_score", "confirm_hits", "confirm_window", "confirm_min_age_s", "confirm_travel_m",
    "confirm_speed_m_s", "confirm_ratio",
)  # fmt: skip
# keys by the choice, and its values, that use them
_USES = {
    ("reporting.method", ("confirmation",)): [f"initiation.{key}" for key in _CONFIRMATION_KEYS],
    ("reporting.method", ("existence",)): ["reporting.max_false_share", "reporting.lag_s"],
    ("detect.detector", ("median-motion", "auto")): ["detect.dolp_boost", "detect.dolp_threshold"],
    ("motion.model", ("imm",)): [
        "motion.straight_s", "motion.stopped_detection_probability", "motion.braking_m_s2",
    ],
    ("association.method", ("mht",)): ["association.scans"],
}  # fmt: skip


WARM_UP, WARM_UP_S = 2, 0.75  # frames and time in which `mosaic` learns the background
MEDIAN_SPACING_S = 0.35  # between frames that `median-motion` stores: at 25 Hz nothing moves between two


class DetectDesign(Design):
    """Detector and searched channel; the ``[track.detect]`` table."""

    detector: Literal["auto", "mosaic", "median-motion"] = "auto"
    """`mosaic` compares the elements of the raw mosaic, before rectification, with their prediction from the
    past of their own kind. `median-motion` compares rectified frames with a sliding median. Both search
    windows of a vehicle's size along straight motions. `auto` is `mosaic` where frames bring their raw
    mosaic, as in every case, and `median-motion` where there are rectified frames only."""
    channel: Literal["pan", "dolp", "all"] = "pan"
    """Part of a frame that is searched: pan, DoLP, or all in one statistic, which is both planes of a
    rectified frame and every element of a mosaic. The case's `channels` set it, one loop each."""
    dolp_boost: float = Field(default=1.0, ge=1, le=100)
    """Factor on DoLP before it is clipped at 1; `median-motion` only. The paper's boost is 5. [1]"""
    dolp_threshold: float = Field(default=0.0, ge=0, lt=1)
    """Value to which smaller DoLP is raised after the boost; `median-motion` only. [1]"""
    max_speed_m_s: float = Field(default=22.0, ge=3, le=60)
    """Greatest speed of the motions along which evidence is added over frames. Processor time of the search
    grows with its square. [m s⁻¹]"""
    sigma_m: float = Field(default=0.6, gt=0, le=100)
    """Standard deviation of a vehicle's position in a rectified frame. [m]"""


class MotionDesign(Design):
    """Motion model of vehicles; the ``[track.motion]`` table."""

    model: Literal["constant-velocity", "imm"] = "constant-velocity"
    """One mode, or four interacting modes: straight, left turn, right turn, stopped."""
    acceleration_psd_m2_s3: float = Field(default=4.0, gt=0, le=1000)
    """Power spectral density of the white acceleration of a moving vehicle. [m² s⁻³]"""
    straight_s: float = Field(default=10.0, gt=0, le=3600)
    """Mean time for which a vehicle drives straight; `imm` only. [s]"""
    stopped_detection_probability: float = Field(default=0.3, ge=0, lt=1)
    """Probability of detection of a stopped vehicle, which change detection forgets; `imm` only. [1]"""
    braking_m_s2: float = Field(default=3.0, ge=0, le=100)
    """Deceleration with which a vehicle may come to a stop between two frames; `imm` only. [m s⁻²]"""

    @property
    def modes(self) -> int:
        """Number of modes of motion."""
        return 1 if self.model == "constant-velocity" else 4


class AssociationDesign(Design):
    """Data association; the ``[track.association]`` table."""

    method: Literal["gnn", "jpda", "mht"] = "gnn"
    """Global nearest neighbour: one detection per track at least total cost (`gnn`). Joint probabilistic data
    association: all gated detections, weighted by loopy message passing (`jpda`). Multi-hypothesis tracking:
    the least costly association over the last scans (`mht`)."""
    scans: int = Field(default=4, ge=1, le=16)
    """Scans after which an association is final, 1 for at once; `mht` only."""
    detection_probability: float = Field(default=0.85, gt=0, lt=1)
    """Probability of detection of a vehicle in view. [1]"""
    gate_probability: float = Field(default=0.9999, gt=0, lt=1)
    """Probability that a vehicle's own detection is gated. [1]"""
    clutter_density_m2: float = Field(default=1.5e-4, gt=0, le=1)
    """Minimum density of false detections in a frame. [m⁻²]"""

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance (two degrees of freedom) of the gate. [1]"""
        return -2.0 * math.log1p(-self.gate_probability)


@dataclass(frozen=True)
class InitiationRules:
    """Rules of confirmation and coasting in use: the keys of the same names, or their preset."""

    confirm_hits: int
    confirm_window: int
    confirm_min_age_s: float
    confirm_travel_m: float
    confirm_speed_m_s: float
    confirm_ratio: float
    tentative_coast_s: float
    stopped_coast_s: float
    coast_ramp_s: float


class InitiationDesign(Design):
    """Track initiation, confirmation, coasting and deletion; the ``[track.initiation]`` table."""

    rules: Literal["change", "existence", "rectified", "frames", "detections"] = "change"
    """Preset of the keys below that are left out (`data/calibration/initiation.toml`): for change detection
    with `confirmation` or `existence` reporting, for rectified frames (`rectified`, and `frames` with the
    detector `median-motion`), or for detections of another program."""
    confirm_score: float = Field(default=6.0, ge=-1000, le=1000)
    """Log-likelihood ratio of vehicle against clutter at which a track is confirmed. [nat]"""
    confirm_hits: int | None = Field(default=None, ge=1, le=32)
    """Number of the last `confirm_window` frames in which a track must be measured (default: see `rules`)."""
    confirm_window: int | None = Field(default=None, ge=1, le=32)
    """Number of frames of which `confirm_hits` are required. If more frames fit into `confirm_min_age_s`, the
    same share of them is required (default: see `rules`)."""
    confirm_min_age_s: float | None = Field(default=None, ge=0, le=3600)
    """Minimum age of a confirmed track (default: see `rules`). [s]"""
    confirm_travel_m: float | None = Field(default=None, ge=0, le=1000)
    """Minimum distance from a track's first position at confirmation (default: see `rules`). [m]"""
    confirm_speed_m_s: float | None = Field(default=None, ge=0, le=100)
    """Minimum speed at confirmation: slower change is parallax (default: see `rules`). [m s⁻¹]"""
    confirm_ratio: float | None = Field(default=None, ge=-1000, le=1000)
    """Log-likelihood ratio of a single detection that confirms a track at once (default: see `rules`). [nat]
    """
    speed_sigma_m_s: float = Field(default=8.0, gt=0, le=100)
    """Largest standard deviation of each speed component of a new track, if its detection has no velocity.
    With `existence` it falls to that of the known vehicles where they are slower. [m s⁻¹]"""
    flow_velocity: bool = True
    """Start a new track with the velocity of the fast traffic around it, learnt from earlier detections."""
    coast_s: float = Field(default=2.0, ge=0, le=3600)
    """Time for which a confirmed track coasts while it moves. [s]"""
    stopped_coast_s: float | None = Field(default=None, ge=0, le=3600)
    """Time for which a confirmed track coasts while it stands (default: see `rules`). [s]"""
    tentative_coast_s: float | None = Field(default=None, ge=0, le=3600)
    """Time for which an unconfirmed track coasts; at least one frame (default: see `rules`). [s]"""
    coast_ramp_s: float | None = Field(default=None, gt=0, le=3600)
    """Time for which a track must be measured to coast for the full time. A track measured for a share of it
    coasts for that share (default: see `rules`). [s]"""
    duplicate_m: float = Field(default=1.8, ge=0, le=100)
    """Two tracks nearer than this with equal velocity are one vehicle; the weaker one is deleted. [m]"""

    @property
    def in_use(self) -> InitiationRules:
        """The keys that are set, and those of the preset for the others."""
        preset = read_calibration("initiation").constants[self.rules]
        own = {name: getattr(self, name) for name in preset}
        return InitiationRules(**{name: preset[name] if v is None else v for name, v in own.items()})

    @model_validator(mode="after")
    def _hits_within_window(self) -> Self:
        if self.confirm_hits is None and self.confirm_window is None:
            return self
        hits, window = self.in_use.confirm_hits, self.in_use.confirm_window
        if hits > window:
            raise ValueError(f"`confirm_hits` must be at most confirm_window, {window}; got {hits}")
        return self


class ReportingDesign(Design):
    """Selection and lag of the reported tracks; the ``[track.reporting]`` table."""

    method: Literal["existence", "confirmation"] = "existence"
    """Report the tracks that are most likely vehicles (`existence`), or all confirmed tracks
    (`confirmation`). With `existence` a model gives each track a probability of existence, and fixed rules
    confirm tracks: `initiation.rules` and `initiation.confirm_…` must be left out. The model needs
    detections with log-likelihood ratios, as the detector `mosaic` gives them. In epochs without them the
    tracker warns and falls back to `confirmation`, with the defaults of these keys."""
    max_false_share: float = Field(default=0.08, ge=0, le=1)
    """Largest expected share of false tracks among the reported ones; `existence` only. [1]"""
    lag_s: float = Field(default=1.5, ge=0, le=60)
    """Fixed lag after which the tracks of an epoch are reported; `existence` only. Later detections within
    the lag decide which tracks are vehicles, and fill gaps and the time before the first detection. Queries
    for spectra do not wait. The model is fitted for 1.5 s. [s]"""
    coasted: bool = True
    """Report tracks at their predicted positions while they are not measured."""
    history: bool = False
    """For ``glintrack track FRAMES`` and `track.track_frames`: report the earlier positions of a track once
    it is confirmed, and the positions in a gap once it is measured again. Positions that are not measured
    by then are left out."""

    @property
    def uses_existence(self) -> bool:
        """Return True if tracks are reported by their probability of existence."""
        return self.method == "existence"

    @property
    def effective_lag_s(self) -> float:
        """The lag in use. [s]"""
        return self.lag_s if self.uses_existence else 0.0


class QueryDesign(Design):
    """Queries for spectra; the ``[track.query]`` table."""

    policy: Literal["none", "random", "entropy"] = "entropy"
    """Query policy: none, random, or largest expected information gain."""
    budget: int = Field(default=20, ge=0, le=100_000)
    """Maximum number of spectra in a frame."""
    at: Literal["prediction", "detection"] = "detection"
    """Spectra of this frame's detections, by a second exposure at once; or of predictions, taken with the
    next frame, which then lacks a pan pixel each, as in the paper."""


class IdentityDesign(Design):
    """Spectral evidence of identity; the ``[track.identity]`` table."""

    outlier_share: float = Field(default=0.3, ge=0, lt=1)
    """Share of spectra that do not show their vehicle's paint. Half of them show the ground next to it, which
    a few of the queries measure. With 0 every spectrum is trusted and the ground is not queried. [1]"""


class RoadsDesign(Design):
    """Road map of the tracker; the ``[track.roads]`` table."""

    prior: bool = False
    """Use the road map that the tracker was given."""


class TrackDesign(Design):
    """Design of the tracker; the ``[track]`` table of a case."""

    detect: DetectDesign = DetectDesign()
    motion: MotionDesign = MotionDesign()
    association: AssociationDesign = AssociationDesign()
    initiation: InitiationDesign = InitiationDesign()
    reporting: ReportingDesign = ReportingDesign()
    query: QueryDesign = QueryDesign()
    identity: IdentityDesign = IdentityDesign()
    roads: RoadsDesign = RoadsDesign()

    @model_validator(mode="after")
    def _no_ignored_keys(self) -> Self:
        preset = {f"initiation.{key}": value for key, value in EXISTENCE_INITIATION.items()}
        refuse_ignored(self, _USES, {**read_data("tracking.toml")["detections"], **preset})
        return self

    def count_learning_frames(self, rate_hz: float) -> int:
        """Count the first frames of a case in which the background is learnt, and no track can exist."""
        if self.detect.detector == "median-motion":
            return 1 + math.ceil(MEDIAN_SPACING_S * rate_hz - 1e-9)
        return max(WARM_UP, math.ceil(WARM_UP_S * rate_hz - 1e-9))

    def effective(self, has_likelihood_ratio: bool) -> "TrackDesign":
        """Design in use for one kind of detections, for the tracker and for what is compared with it.

        Parameters
        ----------
        has_likelihood_ratio
            Whether the detections have log-likelihood ratios.

        Returns
        -------
        With existence reporting, the design with `EXISTENCE_INITIATION`. Without likelihood ratios, the
        design with confirmation reporting.
        """
        if self.reporting.method == "confirmation":
            return self
        if has_likelihood_ratio:
            initiation = self.initiation.model_copy(update=EXISTENCE_INITIATION)
            return self.model_copy(update={"initiation": initiation})
        reporting = ReportingDesign(
            method="confirmation", coasted=self.reporting.coasted, history=self.reporting.history
        )
        return self.model_copy(update={"reporting": reporting})
