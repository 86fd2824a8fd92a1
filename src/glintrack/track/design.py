"""What a user decides about the tracker: change detection, motion, confirmation, queries."""

import math
from typing import Literal

from pydantic import Field, model_validator

from glintrack.designs import Design


class TrackDesign(Design):
    """Design of the tracker; every time is in seconds, so that it means the same at any frame rate.

    Parameters
    ----------
    channel
        What is searched for vehicles: pan, DoLP, or all in one statistic, which is both of the rectified
        frame and every element of a mosaic.
    dolp_boost, dolp_threshold
        Factor on DoLP before it is clipped at 1 (the paper's boost is 5), and the value below which, after
        the boost, all DoLP counts as equal. [1]
    detector
        What a frame is compared with: a clipped exponential mean with a local noise scale; the two frames
        before it, from both of which it must differ; OpenCV's mixture of Gaussians; or, in the raw mosaic
        before rectification, what each element should read by the past of its own kind, over windows of a
        vehicle's size that a straight motion supports.
    threshold
        Change counts where it exceeds this many local noise scales. [1]
    noise_floor
        Least noise scale: a fraction of the frame's median radiance for pan, and absolute for DoLP, where
        the boost therefore lifts weak changes (and false alarms) over it. [1]
    registration_tolerance_m
        Displacement of the frame against the background that is no change. [m]
    parallax_m, parallax_share
        A changed pixel that looks like this share of the unchanged pixels within this distance is an edge
        displaced by parallax, no vehicle; 0 m turns the test off. [m, 1]
    background_s, displaced_s, untracked_s, tracked_s
        Time in which the background learns unchanged pixels, displaced edges, change that no confirmed track
        explains, and change under a confirmed track (long: a vehicle at a red light stays visible). [s]
    scale_s
        Time in which the local noise scale follows. [s]
    fragment_gap_m
        Changed pixels nearer than this belong to one blob. [m]
    area_min_m2, area_max_m2, length_max_m
        Limits of a blob that may be a vehicle. [m², m]
    detection_sigma_m
        Standard deviation of a car's centroid. [m]
    motion
        One mode, or straight, left, right and stopped that interact (IMM).
    acceleration_psd_m2_s3
        Power density of the white acceleration that drives the motion model. [m² s⁻³]
    turn_rate_deg_s, straight_s, turn_s, stop_s
        Rate of a turn, and mean times for which a vehicle drives straight, turns and stands; `imm` only.
        [° s⁻¹, s]
    start_speed_m_s
        Standard deviation of each speed component of a vehicle that drives off; `imm` only. [m s⁻¹]
    stopping_speed_m_s, braking_m_s2
        A vehicle may stand at the next look if its speed, in each component, is 0 within the first plus the
        second times the interval, as one standard deviation; what drives faster does not stand; `imm` only.
        [m s⁻¹, m s⁻²]
    stopped_detection_probability
        Of a vehicle that stands: change detection forgets it; `imm` only. [1]
    association
        Each track its one detection at least total cost (global nearest neighbour), or all gated ones by
        their probabilities (joint probabilistic data association, by loopy belief propagation), or the
        least costly one of what each may have been over the last scans (multi-hypothesis tracking).
    mht_scans, mht_branches
        Scans after which an association is final, 1 for at once, and how many ways a target may have gone
        until then; `mht` only.
    speed_sigma_m_s
        Standard deviation of each speed component of a new track. [m s⁻¹]
    detection_probability, gate_probability
        Of a vehicle in view; that a vehicle's own blob is gated. [1]
    clutter_density_m2, clutter_s
        Least density of false blobs in a frame, and the time in which the clutter map learns. [m⁻², s]
    confirm_hits, confirm_window, confirm_s, confirm_score, confirm_travel_m
        A track is confirmed when M of its last N frames measured it, it is this old [s], its log-likelihood
        ratio reaches the score [nat] and it has moved this far [m] from where it began. If more than N
        frames fit into its least age, the share M/N is asked of them.
    confirm_speed_m_s
        Least speed at which a track is confirmed: what creeps is parallax. [m s⁻¹]
    tentative_misses, tentative_s
        Consecutive frames, or time if that is longer, that an unconfirmed track may miss. [1, s]
    coast_s, stopped_coast_s, stopped_speed_m_s
        How long a confirmed track coasts while it drives, and while it stands: as probably as `imm` holds it
        to, or slower than the speed named with one mode. [s, s, m s⁻¹]
    trust_s
        Time for which a track must be measured to be given these waits in full; one measured for a share of
        it waits as much less, and what a wait has used up is to be earned anew. [s]
    report_coasted
        Report tracks where they are thought to be while they are not measured.
    coast_damping_s
        Time in which the speed of a coasting track decays; `constant-velocity` only. [s]
    coast_sigma_m
        Standard deviation of a position beyond which coasting lets it grow no more. [m]
    duplicate_m
        Two tracks nearer than this with equal speed are one vehicle; the weaker goes. [m]
    road_prior
        Use the road map that the tracker was given (`start`).
    road_half_width_m, road_sigma_m, road_cap
        A detection farther from a lane's centre line than its half width costs as the square of the excess
        over the standard deviation, at most this much. [m, m, nat]
    road_across_sigma_m_s
        Standard deviation of a new track's speed across its road. [m s⁻¹]
    query_policy, query_budget
        Which targets to ask spectra for, and how many a frame at most.
    query_at
        When: of predictions, beside the next frame's exposure, which then lacks a pan pixel each, as in the
        paper; or of this frame's detections, by a second exposure at once. The packaged cases do the latter.
    query_reach_m
        How far along its way from a target's centre a spectrum may be asked, where another target has taken
        the column of the centre; 0 asks at centres only. [m]
    feature_radius_m
        A spectrum belongs to the nearest blob within this distance of the queried point. [m]
    feature_bins, feature_sigma, feature_cap
        Number of spectral bins; spread of one vehicle's spectra relative to all vehicles'; limit of the
        spectrum's log-likelihood ratio. [1, 1, nat]
    feature_measure, feature_projection
        Likelihood ratio of the features, or of the angle between spectra (SAM); means over bins of
        wavelength, or random directions of the logarithm.
    feature_invariance
        What of a log spectrum is illumination: its level, or its level and its slope over ln λ, by which sun
        and shade differ.
    feature_mistaken
        Share of spectra that do not show their vehicle's paint but, as often as not, the ground beside it;
        what that looks like is asked too, with a few of the queries; 0 trusts every spectrum and asks
        none of the ground. [1]
    feature_polarization
        Use Q/I and U/I about a detection, which DoLP and angle of polarization are made of, as features too.
    """

    channel: Literal["pan", "dolp", "all"] = "pan"
    dolp_boost: float = Field(default=1.0, ge=1, le=100)
    dolp_threshold: float = Field(default=0.0, ge=0, lt=1)
    detector: Literal["background", "three-frame", "mog2", "mosaic"] = "background"

    threshold: float = Field(default=3.0, ge=1, le=100)
    noise_floor: float = Field(default=0.01, ge=0, le=1)
    registration_tolerance_m: float = Field(default=0.75, ge=0, le=5)
    parallax_m: float = Field(default=3.0, ge=0, le=20)
    parallax_share: float = Field(default=0.15, gt=0, le=1)
    background_s: float = Field(default=3.0, gt=0)
    displaced_s: float = Field(default=0.5, gt=0)
    untracked_s: float = Field(default=3.0, gt=0)
    tracked_s: float = Field(default=90.0, gt=0)
    scale_s: float = Field(default=3.0, gt=0)
    fragment_gap_m: float = Field(default=1.5, ge=0, le=10)
    area_min_m2: float = Field(default=3.0, ge=0)
    area_max_m2: float = Field(default=90.0, gt=0)
    length_max_m: float = Field(default=22.0, gt=0)
    detection_sigma_m: float = Field(default=0.6, gt=0)

    motion: Literal["constant-velocity", "imm"] = "constant-velocity"
    acceleration_psd_m2_s3: float = Field(default=1.5, gt=0)
    turn_rate_deg_s: float = Field(default=20.0, gt=0, le=90)
    straight_s: float = Field(default=10.0, gt=0)
    turn_s: float = Field(default=3.0, gt=0)
    stop_s: float = Field(default=10.0, gt=0)
    start_speed_m_s: float = Field(default=1.5, gt=0)
    stopping_speed_m_s: float = Field(default=1.0, gt=0)
    braking_m_s2: float = Field(default=3.0, ge=0)
    stopped_detection_probability: float = Field(default=0.3, ge=0, lt=1)
    association: Literal["gnn", "jpda", "mht"] = "gnn"
    mht_scans: int = Field(default=4, ge=1, le=16)
    mht_branches: int = Field(default=8, ge=1, le=100)
    speed_sigma_m_s: float = Field(default=8.0, gt=0)

    detection_probability: float = Field(default=0.85, gt=0, lt=1)
    clutter_density_m2: float = Field(default=1.5e-4, gt=0)
    clutter_s: float = Field(default=5.0, gt=0)
    gate_probability: float = Field(default=0.999, gt=0, lt=1)
    confirm_hits: int = Field(default=3, ge=1, le=32)
    confirm_window: int = Field(default=5, ge=1, le=32)
    confirm_s: float = Field(default=1.0, ge=0)
    confirm_score: float = 6.0
    confirm_travel_m: float = Field(default=8.0, ge=0)
    confirm_speed_m_s: float = Field(default=2.5, ge=0)
    tentative_misses: int = Field(default=1, ge=0)
    tentative_s: float = Field(default=0.5, ge=0)
    coast_s: float = Field(default=2.0, ge=0)
    stopped_coast_s: float = Field(default=20.0, ge=0)
    trust_s: float = Field(default=1.5, gt=0)
    stopped_speed_m_s: float = Field(default=1.5, ge=0)
    report_coasted: bool = True
    coast_damping_s: float = Field(default=3.0, gt=0)
    coast_sigma_m: float = Field(default=20.0, gt=0)
    duplicate_m: float = Field(default=1.8, ge=0)

    road_prior: bool = False
    road_half_width_m: float = Field(default=3.0, ge=0)
    road_sigma_m: float = Field(default=2.0, gt=0)
    road_cap: float = Field(default=4.0, ge=0)
    road_across_sigma_m_s: float = Field(default=2.0, gt=0)

    query_policy: Literal["none", "random", "round-robin", "entropy"] = "entropy"
    query_budget: int = Field(default=20, ge=0)
    query_at: Literal["prediction", "detection"] = Field(
        default="prediction",
        description="spectra of predictions, taken with the next frame, or of this frame's detections, by a "
        "second exposure at once",
    )
    query_reach_m: float = Field(default=1.2, ge=0, le=10)
    feature_radius_m: float = Field(default=1.5, gt=0)
    feature_bins: int = Field(default=8, ge=2, le=64)
    feature_sigma: float = Field(default=0.35, gt=0)
    feature_cap: float = Field(default=6.0, ge=0)
    feature_measure: Literal["likelihood", "sam"] = "likelihood"
    feature_projection: Literal["bins", "random"] = "bins"
    feature_invariance: Literal["level", "tilt"] = "level"
    feature_mistaken: float = Field(default=0.3, ge=0, lt=1)
    feature_polarization: bool = False

    @model_validator(mode="after")
    def _check_pairs(self):
        if self.confirm_hits > self.confirm_window:
            raise ValueError(
                f"`confirm_hits` must not exceed `confirm_window`, got {self.confirm_hits} of "
                f"{self.confirm_window}"
            )
        if self.area_min_m2 >= self.area_max_m2:
            raise ValueError(
                f"`area_min_m2` must be less than `area_max_m2`, "
                f"got {self.area_min_m2} and {self.area_max_m2}"
            )
        if self.feature_measure == "sam" and self.feature_projection != "bins":
            raise ValueError(
                f"`feature_projection` must be 'bins' for the angle between spectra, "
                f"got {self.feature_projection!r}"
            )
        return self

    @property
    def modes(self) -> int:
        """Number of modes of motion."""
        return 1 if self.motion == "constant-velocity" else 4

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance (two degrees of freedom) of the gate. [1]"""
        return -2.0 * math.log1p(-self.gate_probability)
