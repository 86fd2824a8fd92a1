"""The navigator's errors of the reported pose, and the motion of the image during an exposure.

Errors are white, drifting and harmonic. The drift is a first-order Gauss–Markov process: exponentially
correlated, of constant RMS (Maybeck, Stochastic Models, Estimation and Control, vol. 1, 1979, §4.11).

The image's path over the exposure is that of the point on the optical axis, used for the whole frame. That is
exact for rotations of the line of sight and for flight over level ground; the effect of a rotation about the
line of sight on the corners is left out.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import xarray as xr
from jaxtyping import Float
from pydantic import Field
from scipy.ndimage import convolve

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.core.records import Radiance

COMPONENTS = ("east_m", "north_m", "up_m", "heading_rad", "roll_rad", "pitch_rad")


def pose_rms(position_m: float, roll_pitch_deg: float, heading_deg: float) -> Float[Array, "6"]:
    """RMS of the pose error in the order of `COMPONENTS`. [m, rad]"""
    angles = np.radians([heading_deg, roll_pitch_deg, roll_pitch_deg])
    return np.array([*[position_m] * 3, *angles])


# Typical of the class of Applanix POS AV 510 and 610, post-processed; not compared with the data sheet.
# Post-processed errors are slow: all of them drift here.
PRESET_DRIFT = {"pos-av-510": (0.1, 0.005, 0.008), "pos-av-610": (0.1, 0.0025, 0.005)}
JITTER_DEG = 0.005  # RMS of each angle, for the preset `jitter`
HARMONIC_HZ = 11.0  # frequency of the sine


class NavigationDesign(Design):
    """Errors of the reported pose; the ``[navigation]`` table of a case.

    Three parts add up: white from frame to frame, a drift with a correlation time, and a sine.
    """

    preset: Literal["perfect", "pos-av-510", "pos-av-610", "jitter"] = "perfect"
    """Drift and sine where their keys are left out."""
    position_rms_m: float = Field(default=0.0, ge=0, le=1000, description="White error, RMS along each axis")
    roll_pitch_rms_deg: float = Field(default=0.0, ge=0, le=10)
    """White error, RMS of roll and of pitch."""
    heading_rms_deg: float = Field(default=0.0, ge=0, le=10, description="White error, RMS of heading")
    drift_position_rms_m: float | None = Field(default=None, ge=0, le=1000)
    """Gauss–Markov error, RMS along each axis."""
    drift_angle_rms_deg: float | None = Field(default=None, ge=0, le=10)
    """Gauss–Markov error, RMS of roll, of pitch and of heading."""
    drift_time_s: float = Field(default=60.0, gt=0, le=1e5)
    """Correlation time of the drift: 1/e of its covariance is left."""
    harmonic_angle_rms_deg: float | None = Field(default=None, ge=0, le=10)
    """Sine, RMS of roll, of pitch and of heading."""

    @property
    def drift(self) -> Float[Array, "6"]:
        """RMS of the drift, by its keys or the preset: see `pose_rms`. [m, rad]"""
        position_m, roll_pitch_deg, heading_deg = PRESET_DRIFT.get(self.preset, (0.0, 0.0, 0.0))
        if self.drift_position_rms_m is not None:
            position_m = self.drift_position_rms_m
        if self.drift_angle_rms_deg is not None:
            roll_pitch_deg = heading_deg = self.drift_angle_rms_deg
        return pose_rms(position_m, roll_pitch_deg, heading_deg)

    @property
    def harmonic(self) -> Float[Array, "6"]:
        """RMS of the sine, by its key or the preset: see `pose_rms`. [m, rad]"""
        angle = self.harmonic_angle_rms_deg
        if angle is None:
            angle = JITTER_DEG if self.preset == "jitter" else 0.0
        return pose_rms(0.0, angle, angle)


def navigation_errors(
    design: NavigationDesign, times_s: Float[Array, "time"], rngs: Sequence[np.random.Generator]
) -> Float[Array, "time 6"]:
    """Errors of the reported pose at each frame of a flight.

    Parameters
    ----------
    design
        RMS of the three parts.
    times_s
        Times of the frames, rising. [s]
    rngs
        One generator a frame: twelve normal deviates and six uniform ones are drawn from each for any design,
        so that designs stay paired frame by frame.

    Returns
    -------
    Reported less true, in the order of `COMPONENTS`. [m, rad]
    """
    times_s = np.asarray(times_s, dtype=float)
    if len(rngs) != len(times_s):
        raise ValueError(f"`rngs` must hold one generator a frame; got {len(rngs)} for {len(times_s)}.")
    normal = np.array([rng.standard_normal(12) for rng in rngs]).reshape(-1, 12)
    phase = np.array([rng.uniform(0, 2 * math.pi, 6) for rng in rngs]).reshape(-1, 6)
    white = pose_rms(design.position_rms_m, design.roll_pitch_rms_deg, design.heading_rms_deg)
    drift = normal[:, 6:].copy()  # of unit variance and covariance e^(−|Δt|/τ)
    for k in range(1, len(drift)):
        memory = math.exp(-(times_s[k] - times_s[k - 1]) / design.drift_time_s)
        drift[k] = memory * drift[k - 1] + math.sqrt(1 - memory**2) * drift[k]
    # the first frame's phases are those of the whole flight
    wave = math.sqrt(2) * np.sin(2 * math.pi * HARMONIC_HZ * times_s[:, None] + phase[:1])
    return white * normal[:, :6] + design.drift * drift + design.harmonic * wave


def navigate(true_pose: Pose, error: Float[Array, "6"]) -> Pose:
    """Add the error of one frame from `navigation_errors` [m, rad] to the true pose."""
    changed = {n: getattr(true_pose, n) + float(e) for n, e in zip(COMPONENTS, error, strict=True)}
    return replace(true_pose, **changed, kind="reported")


MAX_MOTION_SAMPLES = 4096
MIN_MOTION_ELEMENTS = 0.05  # a smaller RMS motion blurs less than a hundredth of the lens's spot


def image_motion(
    camera: Camera,
    pose_at: Callable[[float], Pose],
    time_s: float,
    integration_s: float,
    ground_m: float = 0.0,
    samples: int = 33,
) -> Float[Array, "sample 2"]:
    """Path of the image over one exposure, about its mean.

    Parameters
    ----------
    pose_at
        True pose as a function of time, as `Flight.pose`.
    time_s, integration_s
        Middle and length of the exposure. [s]
    ground_m
        Height of the ground on the optical axis. [m]
    samples
        Least number of instants, evenly over the exposure; a long path gets two per element.

    Returns
    -------
    (row, column) of the point on the optical axis in mid-exposure. [element]
    """
    centre = pose_at(time_s)
    target = ground_points(camera, centre, camera.principal_point, ground_m)
    if not np.isfinite(target).all():  # looking at the sky: a very far point
        target = ground_points(camera, centre, camera.principal_point, centre.up_m + 1e6)

    def path_at(count: int) -> Array:
        instants = time_s + integration_s * ((np.arange(count) + 0.5) / count - 0.5)
        return np.array([project(camera, pose_at(t), target) for t in instants])

    path = path_at(samples)
    needed = math.ceil(2 * float(np.hypot(*np.diff(path, axis=0).T).sum()))
    if needed > samples:  # fewer would be as many separate images
        path = path_at(min(needed, MAX_MOTION_SAMPLES))
    return path - path.mean(axis=0)


def motion_kernel(path: Float[Array, "sample 2"]) -> Float[Array, "row column"]:
    """Blur kernel of a path from `image_motion` [element]: odd in size, sum 1, bilinear."""
    reach = math.ceil(float(np.abs(path).max(initial=0.0)))
    kernel = np.zeros((2 * reach + 3, 2 * reach + 3))
    corner = np.floor(path).astype(int)
    part = path - corner
    for row in (0, 1):
        for column in (0, 1):
            weight = np.abs(1 - row - part[:, 0]) * np.abs(1 - column - part[:, 1])
            np.add.at(kernel, (corner[:, 0] + row + reach + 1, corner[:, 1] + column + reach + 1), weight)
    return kernel / kernel.sum()


def smear(radiance: Radiance, path: Float[Array, "sample 2"]) -> Radiance:
    """Blur the frames of a radiance by the motion over the exposure.

    Parameters
    ----------
    radiance
        ``radiance(channels)`` as for `expose`; single pixels (the spectrometer's) stay as they are.
    path
        From `image_motion`; under `MIN_MOTION_ELEMENTS` nothing changes. [element]
    """
    if math.hypot(*np.std(path, axis=0)) < MIN_MOTION_ELEMENTS:
        return radiance
    kernel = motion_kernel(path)

    def blur(channels: Array, pixels: Array | None = None) -> xr.DataArray:
        if pixels is not None:
            return radiance(channels, pixels)
        light = radiance(channels)
        values = convolve(light.values, kernel[(...,) + (None,) * (light.ndim - 2)], mode="nearest")
        return light.copy(data=values)

    return blur
