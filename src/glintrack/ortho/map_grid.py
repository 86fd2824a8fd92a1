"""Grids of orthophotos in any CRS: over an area, or over the ground that a photograph sees."""

import math
from dataclasses import dataclass

import numpy as np
from rasterio.crs import CRS

from glintrack.camera import Camera, ground_points
from glintrack.core.arrays import Array
from glintrack.io.photographs import PlacedPose
from glintrack.io.untrusted import COARSEST_M, FARTHEST_M
from glintrack.ortho.grid import transform_axes, transform_places

_MOST_CELLS = 400e6
_OUTWARD = (math.floor, math.floor, math.ceil, math.ceil)


@dataclass(frozen=True)
class MapGrid:
    """Centres of an orthophoto's cells in its own CRS, falling northings.

    Parameters
    ----------
    x, y, gsd
        Axes and cell. [unit of crs]
    crs
        Anything that PROJ understands.
    """

    x: Array
    y: Array
    gsd: float
    crs: str

    @classmethod
    def over(
        cls,
        camera: Camera,
        placed: PlacedPose,
        levels_m: tuple[float, float],
        crs: str | None = None,
        gsd: float | None = None,
        area: tuple[float, float, float, float] | None = None,
    ) -> "MapGrid":
        """Grid over what a camera sees between two heights, or over an area; see `photograph.rectify`."""
        own = placed.crs if crs is None else crs
        if area is None:
            area = _seen(camera, placed, levels_m, own)
        if gsd is None:
            if crs is not None and CRS.from_user_input(own).is_geographic:
                raise ValueError(f"`gsd` must be given in degrees for a geographic CRS, got none for {crs}")
            gsd = _pixel_on_ground(camera, placed, sum(levels_m) / 2)
        if not 0 < gsd <= COARSEST_M:
            raise ValueError(f"`gsd` must be positive and at most {COARSEST_M:g}, got {gsd:g}")
        if not all(abs(v) <= FARTHEST_M for v in area):
            raise ValueError(
                f"`area` must lie within ±{FARTHEST_M:g}, got {' '.join(f'{v:g}' for v in area)}"
            )
        west, south, east, north = (f(v / gsd) * gsd for f, v in zip(_OUTWARD, area, strict=True))
        if not (west < east and south < north):
            raise ValueError(f"`area` must be west south east north and not empty, got {area}")
        if (east - west) / gsd * (north - south) / gsd > _MOST_CELLS:
            low = f" (the lens at {placed.pose.up_m:g} m lies below ground of {levels_m[1]:g} m)"
            raise ValueError(
                f"`gsd` must be larger, or `area` smaller, got {(east - west) / gsd:.3g} × "
                f"{(north - south) / gsd:.3g} cells{low if placed.pose.up_m < levels_m[1] else ''}"
            )
        columns, rows = max(round((east - west) / gsd), 2), max(round((north - south) / gsd), 2)
        x, y = west + gsd * (np.arange(columns) + 0.5), north - gsd * (np.arange(rows) + 0.5)
        return cls(x, y, gsd, own)

    def moved(self, rows: float, columns: float) -> "MapGrid":
        """Where the picture's content of each cell was found."""
        return MapGrid(self.x + columns * self.gsd, self.y - rows * self.gsd, self.gsd, self.crs)

    def places(self, placed: PlacedPose) -> tuple[Array, Array]:
        """East and north of every cell from the pose's origin. [m]"""
        east, north = transform_axes(self.x, self.y, self.crs, placed.crs)
        return east - placed.origin_m[0], north - placed.origin_m[1]


def frame_border(camera: Camera) -> Array:
    """Pixels' outer corners and edges, every one on the border of the frame."""
    rows = np.linspace(-0.5, camera.rows - 0.5, 33)
    columns = np.linspace(-0.5, camera.columns - 0.5, 33)
    edges = [np.stack(np.broadcast_arrays(r, columns), -1) for r in (rows[0], rows[-1])]
    edges += [np.stack(np.broadcast_arrays(rows, c), -1) for c in (columns[0], columns[-1])]
    return np.concatenate(edges)


def _seen(camera: Camera, placed: PlacedPose, levels: tuple[float, float], crs: str) -> tuple:
    """Bounds, in a CRS, of the ground that the frame sees between two heights."""
    heights = [h for h in levels if h < placed.pose.up_m]
    border = np.concatenate([ground_points(camera, placed.pose, frame_border(camera), h) for h in heights])
    east, north = border[:, 0] + placed.origin_m[0], border[:, 1] + placed.origin_m[1]
    places = np.stack(transform_places(east, north, placed.crs, crs), axis=-1)
    return (*places.min(axis=0).tolist(), *places.max(axis=0).tolist())


def _pixel_on_ground(camera: Camera, placed: PlacedPose, level: float) -> float:
    """Side of a square as large as the middle pixel's share of the ground, to two digits. [m]"""
    row, column = camera.principal_point
    corners = np.array([[row, column], [row + 1, column], [row, column + 1]])
    a, b, c = ground_points(camera, placed.pose, corners, min(level, placed.pose.up_m - 1))
    side = math.sqrt(float(np.linalg.norm(np.cross(b - a, c - a))))
    return float(f"{side:.2g}")
