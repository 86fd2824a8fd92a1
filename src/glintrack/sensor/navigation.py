"""The navigator: what it reports of the true pose."""

import math
from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ..camera import Pose


class NavigationDesign(BaseModel):
    """White errors of the reported pose; the ``[navigation]`` table of a case. Zero is perfect."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    position_rms_m: float = Field(default=0.0, ge=0, le=1000, description="RMS along each axis")
    roll_pitch_rms_deg: float = Field(default=0.0, ge=0, le=10, description="RMS of roll and of pitch")
    heading_rms_deg: float = Field(default=0.0, ge=0, le=10, description="RMS of heading")


def navigate(true_pose: Pose, design: NavigationDesign, rng: np.random.Generator) -> Pose:
    """The pose as the navigator reports it: the true one plus white errors.

    Parameters
    ----------
    true_pose
        Where the camera is.
    design
        RMS errors.
    rng
        Six normal deviates are drawn whatever the design, so that designs stay paired frame by frame.
    """
    deviate = rng.standard_normal(6)
    angle = math.radians(design.roll_pitch_rms_deg)
    return replace(
        true_pose,
        east_m=true_pose.east_m + design.position_rms_m * deviate[0],
        north_m=true_pose.north_m + design.position_rms_m * deviate[1],
        up_m=true_pose.up_m + design.position_rms_m * deviate[2],
        heading_rad=true_pose.heading_rad + math.radians(design.heading_rms_deg) * deviate[3],
        roll_rad=true_pose.roll_rad + angle * deviate[4],
        pitch_rad=true_pose.pitch_rad + angle * deviate[5],
        kind="reported",
    )
