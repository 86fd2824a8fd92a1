"""Design of the tracker: the ``[track]`` table of a case, one table in it for each part.

Every time is in seconds, so that it means the same at any frame rate.
"""

import math
from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from glintrack.core.designs import Design
from glintrack.track.detect.design import DetectDesign

# Confirmation with existence reporting: generous, since reporting decides. Chosen with the existence model.
CONFIRMATION_RULES: Mapping[str, Any] = {
    "confirm_hits": 2,
    "confirm_window": 5,
    "confirm_s": 0.0,
    "confirm_score": 2.0,
    "confirm_ratio": -2.0,
    "confirm_travel_m": 1.0,
    "confirm_speed_m_s": 0.5,
}


class MotionDesign(Design):
    """How vehicles move; the ``[track.motion]`` table."""

    model: Literal["constant-velocity", "imm"] = "constant-velocity"
    """One mode, or straight, left, right and stopped that interact."""
    acceleration_psd_m2_s3: float = Field(default=4.0, gt=0, le=1000)
    """Power density of the white acceleration that drives a moving vehicle. [m² s⁻³]"""
    turn_rate_deg_s: float = Field(default=20.0, gt=0, le=90)
    """Rate of a turn; `imm` only. [° s⁻¹]"""
    straight_s: float = Field(default=10.0, gt=0, le=3600)
    """Mean time for which a vehicle drives straight; `imm` only. [s]"""
    stopping_speed_m_s: float = Field(default=1.0, gt=0, le=100)
    """A vehicle may stand at the next frame if its speed, in each component, is 0 within this plus what it
    can brake in the interval, as one standard deviation; `imm` only. [m s⁻¹]"""
    braking_m_s2: float = Field(default=3.0, ge=0, le=100)
    """How hard a vehicle brakes; `imm` only. [m s⁻²]"""
    stopped_detection_probability: float = Field(default=0.3, ge=0, lt=1)
    """Probability that a vehicle which stands is detected: change detection forgets it; `imm` only. [1]"""

    @property
    def modes(self) -> int:
        """Number of modes of motion."""
        return 1 if self.model == "constant-velocity" else 4


class AssociationDesign(Design):
    """Which detection is whose; the ``[track.association]`` table."""

    method: Literal["gnn", "jpda", "mht"] = "gnn"
    """Each track its one detection at least total cost (global nearest neighbour), or all gated ones by their
    probabilities (joint probabilistic data association, by loopy belief propagation), or the least costly one
    of what each may have been over the last scans (multi-hypothesis tracking)."""
    scans: int = Field(default=4, ge=1, le=16)
    """Scans after which an association is final, 1 for at once; `mht` only."""
    branches: int = Field(default=8, ge=1, le=100)
    """How many ways a target may have gone until then; `mht` only."""
    detection_probability: float = Field(default=0.85, gt=0, lt=1)
    """Probability that a vehicle in view is detected. [1]"""
    gate_probability: float = Field(default=0.9999, gt=0, lt=1)
    """Probability that a vehicle's own detection is gated. [1]"""
    clutter_density_m2: float = Field(default=1.5e-4, gt=0, le=1)
    """Least density of false detections in a frame. [m⁻²]"""

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance (two degrees of freedom) of the gate. [1]"""
        return -2.0 * math.log1p(-self.gate_probability)


class InitiationDesign(Design):
    """When a track begins, is confirmed, waits and ends; the ``[track.initiation]`` table."""

    speed_sigma_m_s: float = Field(default=8.0, gt=0, le=100)
    """Standard deviation of each speed component of a new track. [m s⁻¹]"""
    confirm_hits: int = Field(default=3, ge=1, le=32)
    """A track is confirmed when so many of its last `confirm_window` frames measured it."""
    confirm_window: int = Field(default=5, ge=1, le=32)
    """If more frames than this fit into `confirm_s`, the share `confirm_hits` / `confirm_window` is asked of
    them."""
    confirm_s: float = Field(default=1.0, ge=0, le=3600)
    """Least age at which a track is confirmed. [s]"""
    confirm_score: float = Field(default=6.0, ge=-1000, le=1000)
    """Log-likelihood ratio of vehicle against clutter at which a track is confirmed. [nat]"""
    confirm_ratio: float = Field(default=1000.0, ge=-1000, le=1000)
    """Log-likelihood ratio of a single detection that confirms a track at once: for detectors that decide by
    several frames, as `median-motion` does. [nat]"""
    confirm_travel_m: float = Field(default=8.0, ge=0, le=1000)
    """How far a track must have moved from where it began. [m]"""
    confirm_speed_m_s: float = Field(default=2.5, ge=0, le=100)
    """Least speed at which a track is confirmed: what creeps is parallax. [m s⁻¹]"""
    tentative_s: float = Field(default=0.5, ge=0, le=3600)
    """Time that it may miss, if that is longer. [s]"""
    coast_s: float = Field(default=2.0, ge=0, le=3600)
    """How long a confirmed track coasts while it drives. [s]"""
    stopped_coast_s: float = Field(default=20.0, ge=0, le=3600)
    """How long it coasts while it stands. [s]"""
    quality_s: float = Field(default=2.5, gt=0, le=3600)
    """Time for which a track must be measured to be given these waits in full; one measured for a share of it
    waits as much less, and what a wait has used up is to be earned anew. [s]"""
    duplicate_m: float = Field(default=1.8, ge=0, le=100)
    """Two tracks nearer than this with equal speed are one vehicle; the weaker goes. [m]"""

    @model_validator(mode="after")
    def _hits_within_window(self) -> Self:
        if self.confirm_hits > self.confirm_window:
            raise ValueError(
                f"`confirm_hits` must not exceed `confirm_window`, got {self.confirm_hits} of "
                f"{self.confirm_window}"
            )
        return self


class ReportingDesign(Design):
    """Which tracks are reported, and when; the ``[track.reporting]`` table."""

    method: Literal["existence", "confirmation"] = "existence"
    """Report the tracks that are most likely vehicles (`existence`), or all confirmed tracks
    (`confirmation`). With `existence` a model gives each track a probability of existence, and fixed rules
    confirm tracks: the keys `initiation.confirm_…` must keep their defaults. The model needs detections with
    log-likelihood ratios, as the detector `mosaic` gives them. In epochs without them the tracker falls back
    to `confirmation`, with the defaults of these keys."""
    max_false_share: float = Field(default=0.1, ge=0, le=1)
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
        """Whether tracks are reported by their probability of existence."""
        return self.method == "existence"

    @property
    def effective_lag_s(self) -> float:
        """The lag in use. [s]"""
        return self.lag_s if self.uses_existence else 0.0


class QueryDesign(Design):
    """Whom to ask spectra for, and when; the ``[track.query]`` table."""

    policy: Literal["none", "random", "round-robin", "entropy"] = "entropy"
    """Nobody; by chance; who has waited longest; whose spectrum is expected to tell most."""
    budget: int = Field(default=20, ge=0, le=100_000)
    """Most spectra a frame."""
    at: Literal["prediction", "detection"] = "detection"
    """Spectra of this frame's detections, by a second exposure at once; or of predictions, taken with the
    next frame, which then lacks a pan pixel each, as in the paper."""


class IdentityDesign(Design):
    """What a spectrum says about who a vehicle is; the ``[track.identity]`` table."""

    bins: int = Field(default=8, ge=2, le=64)
    """Number of spectral bins, which are the features."""
    cap: float = Field(default=6.0, ge=0, le=1000)
    """Limit of the features' log-likelihood ratio. [nat]"""
    outlier_share: float = Field(default=0.3, ge=0, lt=1)
    """Share of spectra that do not show their vehicle's paint but, as often as not, the ground beside it;
    what that looks like is asked too, with a few of the queries; 0 trusts every spectrum and asks none of
    the ground. [1]"""


class RoadsDesign(Design):
    """What a road map says; the ``[track.roads]`` table."""

    prior: bool = False
    """Use the road map that the tracker was given."""
    sigma_m: float = Field(default=2.0, gt=0, le=100)
    """A detection farther than 3 m from a lane's centre line costs as the square of the excess over this
    standard deviation. [m]"""
    cap: float = Field(default=4.0, ge=0, le=1000)
    """It never costs more: vehicles may stand anywhere. [nat]"""


class TrackDesign(Design):
    """Design of the tracker; the ``[track]`` table of a case."""

    detect: DetectDesign = DetectDesign()
    """What finds vehicles in frames."""
    motion: MotionDesign = MotionDesign()
    """How vehicles move."""
    association: AssociationDesign = AssociationDesign()
    """Which detection is whose."""
    initiation: InitiationDesign = InitiationDesign()
    """When a track begins, is confirmed, waits and ends."""
    reporting: ReportingDesign = ReportingDesign()
    """Which tracks are reported, and when."""
    query: QueryDesign = QueryDesign()
    """Whom to ask spectra for, and when."""
    identity: IdentityDesign = IdentityDesign()
    """What a spectrum says about who a vehicle is."""
    roads: RoadsDesign = RoadsDesign()
    """What a road map says."""

    @model_validator(mode="after")
    def _no_key_that_reporting_ignores(self) -> Self:
        method = self.reporting.method
        if method == "existence":
            key, table, other, ignored = "initiation", self.initiation, "confirmation", [*CONFIRMATION_RULES]
        else:
            key, table, other, ignored = (
                "reporting",
                self.reporting,
                "existence",
                ["max_false_share", "lag_s"],
            )
        for name in ignored:
            allowed = {type(table).model_fields[name].default, CONFIRMATION_RULES.get(name)}
            if getattr(table, name) not in allowed:
                raise ValueError(
                    f"`{key}.{name}` must be left out with reporting.method = {method!r}, which ignores it, "
                    f"got {getattr(table, name):g} (reporting.method = {other!r} uses it)"
                )
        return self

    def effective(self, has_likelihood_ratio: bool) -> "TrackDesign":
        """The design in use for detections of one kind, for the tracker and for what is compared with it.

        Parameters
        ----------
        has_likelihood_ratio
            Whether the detections have log-likelihood ratios.

        Returns
        -------
        With existence reporting, the design with `CONFIRMATION_RULES`. Without likelihood ratios, the design
        with confirmation reporting.
        """
        if self.reporting.method == "confirmation":
            return self
        if has_likelihood_ratio:
            return self.model_copy(
                update={"initiation": self.initiation.model_copy(update=CONFIRMATION_RULES)}
            )
        own = self.reporting
        reporting = ReportingDesign(method="confirmation", coasted=own.coasted, history=own.history)
        return self.model_copy(update={"reporting": reporting})
