"""Design of detectors: the ``[track.detect]`` table of a case."""

from typing import Literal

from pydantic import Field

from glintrack.core.designs import Design


class DetectDesign(Design):
    """Which detector searches which channel."""

    detector: Literal["auto", "mosaic", "median-motion"] = "auto"
    """`mosaic` compares the elements of the raw mosaic, before rectification, with their prediction from the
    past of their own kind. `median-motion` compares rectified frames with a sliding median. Both search
    windows of a vehicle's size along straight motions. `auto` is `mosaic` where frames bring their raw
    mosaic, as in every case, and `median-motion` where there are rectified frames only."""
    channel: Literal["pan", "dolp", "all"] = "pan"
    """Part of a frame that is searched: pan, DoLP, or all in one statistic, which is both planes of a
    rectified frame and every element of a mosaic. The case's `channels` set it, one loop each."""
    dolp_boost: float = Field(default=1.0, ge=1, le=100)
    """Factor on DoLP before it is clipped at 1, in rectified frames; the paper's boost is 5. [1]"""
    dolp_threshold: float = Field(default=0.0, ge=0, lt=1)
    """Value to which smaller DoLP is raised after the boost, in rectified frames. [1]"""
    max_speed_m_s: float = Field(default=22.0, ge=3, le=60)
    """Greatest speed of a vehicle along whose motion evidence is added over frames. Processor time of the
    search grows with its square. [m s⁻¹]"""
    sigma_m: float = Field(default=0.6, gt=0, le=100)
    """Standard deviation of a vehicle's position in a rectified frame. [m]"""
