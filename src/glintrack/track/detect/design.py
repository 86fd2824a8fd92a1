"""Design of detectors: the ``[track.detect]`` table of a case."""

from typing import Literal, Self

from pydantic import Field, model_validator

from glintrack.core.designs import Design


class DetectDesign(Design):
    """Which detector searches what, and when a change may be a vehicle."""

    detector: Literal["auto", "background", "three-frame", "mog2", "mosaic", "median-motion"] = "auto"
    """What a frame is compared with: a clipped exponential mean with a local noise scale (`background`); the
    two frames before it, from both of which it must differ; OpenCV's mixture of Gaussians; or, in the raw
    mosaic before rectification, what each element should read by the past of its own kind, over windows of a
    vehicle's size that a straight motion supports (`mosaic`); `median-motion` is described in
    docs/tracking.md. `auto` is `mosaic` where frames bring their raw
    mosaic, as in every case, and `background` where they are rectified alone."""
    channel: Literal["pan", "dolp", "all"] = "pan"
    """What of a frame is searched: pan, DoLP, or all in one statistic, which is both of the rectified frame
    and every element of a mosaic. The case's `channels` set it, one loop each."""
    dolp_boost: float = Field(default=1.0, ge=1, le=100)
    """Factor on DoLP before it is clipped at 1; the paper's boost is 5. [1]"""
    dolp_threshold: float = Field(default=0.0, ge=0, lt=1)
    """Value below which, after the boost, all DoLP counts as equal. [1]"""
    threshold: float = Field(default=3.0, ge=1, le=100)
    """Change counts where it exceeds this many local noise scales. [1]"""
    noise_floor: float = Field(default=0.01, ge=0, le=1)
    """Least noise scale: a fraction of the frame's median radiance for pan, and absolute for DoLP, where the
    boost therefore lifts weak changes (and false alarms) over it. [1]"""
    registration_tolerance_m: float = Field(default=0.75, ge=0, le=5)
    """Displacement of the frame against the background that is no change. [m]"""
    parallax_m: float = Field(default=3.0, ge=0, le=20)
    """A changed pixel that looks like the unchanged ones within this distance is an edge displaced by
    parallax, no vehicle; 0 turns the test off. [m]"""
    parallax_share: float = Field(default=0.15, gt=0, le=1)
    """Share of those unchanged pixels that it must look like. [1]"""
    background_s: float = Field(default=3.0, gt=0, le=3600)
    """Time in which the background follows unchanged pixels. [s]"""
    displaced_s: float = Field(default=0.5, gt=0, le=3600)
    """Time in which it follows displaced edges. [s]"""
    untracked_s: float = Field(default=3.0, gt=0, le=3600)
    """Time in which it follows change that no confirmed track explains. [s]"""
    tracked_s: float = Field(default=90.0, gt=0, le=36000)
    """Time in which it follows change under a confirmed track; long, so that a vehicle at a red light stays
    visible. [s]"""
    scale_s: float = Field(default=3.0, gt=0, le=3600)
    """Time in which the local noise scale follows. [s]"""
    fragment_gap_m: float = Field(default=1.5, ge=0, le=10)
    """Changed pixels nearer than this belong to one blob. [m]"""
    area_min_m2: float = Field(default=3.0, ge=0, le=10000)
    """Least area of a blob that may be a vehicle. [m²]"""
    area_max_m2: float = Field(default=90.0, gt=0, le=10000)
    """Largest area of a blob that may be a vehicle. [m²]"""
    length_max_m: float = Field(default=22.0, gt=0, le=1000)
    """Greatest length of a blob that may be a vehicle. [m]"""
    sigma_m: float = Field(default=0.6, gt=0, le=100)
    """Standard deviation of a car's centroid. [m]"""

    @model_validator(mode="after")
    def _areas_in_order(self) -> Self:
        if self.area_min_m2 >= self.area_max_m2:
            raise ValueError(
                f"`area_min_m2` must be less than `area_max_m2`, "
                f"got {self.area_min_m2} and {self.area_max_m2}"
            )
        return self
