"""Small records that pass between stages; everything larger is a labelled array (`schema`)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray


@dataclass(frozen=True)
class Detection:
    """One blob of change in one rectified frame.

    Parameters
    ----------
    east_m, north_m
        Centroid. [m]
    east_var_m2, north_var_m2, east_north_cov_m2
        Covariance of the centroid. [m²]
    extent_m
        Diameter of the disc of equal area. [m]
    contrast
        Peak of the change statistic over its threshold. [1]
    """

    east_m: float
    north_m: float
    east_var_m2: float
    north_var_m2: float
    east_north_cov_m2: float = 0.0
    extent_m: float = 0.0
    contrast: float = 1.0


@dataclass(frozen=True)
class Track:
    """One track at one epoch, as the tracker reports it.

    Parameters
    ----------
    track_id
        Never reused within a run.
    time_s
        Epoch. [s]
    east_m, north_m, east_speed_m_s, north_speed_m_s
        Filtered state. [m, m s⁻¹]
    east_var_m2, north_var_m2
        Variance of the position. [m²]
    status
        ``"measured"`` if a detection updated it at this epoch, ``"coasted"`` if not.
    """

    track_id: int
    time_s: float
    east_m: float
    north_m: float
    east_speed_m_s: float
    north_speed_m_s: float
    east_var_m2: float
    north_var_m2: float
    status: str


@dataclass(frozen=True)
class SpectralQuery:
    """The tracker's wish for the spectrum of one ground point in the next frame.

    Parameters
    ----------
    east_m, north_m, up_m
        Ground point. [m]
    track_id
        Track the spectrum is for; −1 if for a detection not yet on a track.
    priority
        Expected gain, larger first. [nat]
    """

    east_m: float
    north_m: float
    up_m: float = 0.0
    track_id: int = -1
    priority: float = 0.0

    @property
    def position(self) -> Float[Array, "3"]:
        """Ground point (east, north, up). [m]"""
        return np.array([self.east_m, self.north_m, self.up_m], dtype=float)


@dataclass(frozen=True)
class ServedQueries:
    """Which queries the spectrometer serves in one frame, and with which micromirrors.

    Parameters
    ----------
    queries
        The queries that were asked, in the order asked.
    rows, columns
        Superpixel whose mirror serves each query; −1 where refused. [superpixel]
    refusals
        Why each query was refused, empty where it was served.
    """

    queries: tuple[SpectralQuery, ...]
    rows: Int[Array, "query"]
    columns: Int[Array, "query"]
    refusals: tuple[str, ...]

    @property
    def served(self) -> np.ndarray:
        """True for each query that gets a mirror."""
        return self.rows >= 0
