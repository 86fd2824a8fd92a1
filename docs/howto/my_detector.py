"""A detector of one's own: what is brighter than the mean of the frames so far, and is not tracked."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from glintrack import Case, simulate, track


@dataclass(frozen=True)
class Brighter:
    """Blobs that exceed the mean by so many of the frame's standard deviations."""

    threshold: float = 4.0
    share: float = 0.2

    def start(self, frame):
        """No mean yet."""
        return None

    def detect(self, state, frame):
        """Where the frame is brighter than the mean."""
        pan = frame.image["pan"].values
        change = np.nan_to_num(pan - (pan if state is None else state))
        level = max(self.threshold * 1.48 * np.median(np.abs(change)), 1e-6)
        labels, count = ndimage.label(change > level)
        index = np.arange(1, count + 1)
        row, column = np.array(ndimage.center_of_mass(change, labels, index)).reshape(-1, 2).T
        (west, north), gsd_m = frame.grid.corner_m, frame.grid.gsd_m
        area_m2 = ndimage.sum(labels > 0, labels, index) * gsd_m**2
        return track.Detections(
            position=np.stack([west + gsd_m * column, north - gsd_m * row], axis=1),
            covariance=np.repeat(np.eye(2)[None], count, axis=0),
            extent=np.sqrt(4 / np.pi * area_m2),
            contrast=np.asarray(ndimage.maximum(change, labels, index)) / level,
            detail=labels,
        )

    def update(self, state, frame, detections, association):
        """Update the mean, but not where a track explains the change."""
        pan = frame.image["pan"].values
        if state is None:
            return pan
        tracked = np.isin(detections.detail, 1 + np.flatnonzero(association.explained))
        new = np.where(tracked | np.isnan(pan), state, state + self.share * (pan - state))
        return np.where(np.isnan(state), pan, new)


case = Case.from_toml("small.toml").replace({"channels": ["pan"]})
print(simulate(case, detectors={"pan": Brighter()})["pan"].attrs["completeness"])
