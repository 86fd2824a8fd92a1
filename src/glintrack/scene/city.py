"""The city: what stands, what moves, and where everything is at any time."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import pyproj
import xarray as xr
from jaxtyping import Float, Int
from pydantic import BaseModel, ConfigDict, Field

from glintrack import schema
from glintrack.scene.braunschweig import braunschweig_layout, braunschweig_recording
from glintrack.scene.embedded import embedded_layout, embedded_recording
from glintrack.scene.geometry import Mesh
from glintrack.scene.layout import MARGIN_M, body_to_enu, build_mesh
from glintrack.scene.materials import choose_paints, load_materials, material_index
from glintrack.scene.recording import Recording
from glintrack.scene.traffic import Traffic, truth_dataset
from glintrack.scene.vehicles import build_models

Array = np.ndarray
EXTENT_M = (-330.0, -210.0, 330.0, 210.0)
VEHICLE_MARGIN_M = 30.0  # vehicles are kept this far beyond: their shadows and mirror images reach in
_TERRAIN_STEP_M = 10.0
_PARKED_PAINT_KEY = 1_000_000  # parked vehicles draw their paints from other keys than driving ones
# The embedded city stands nowhere; it is given the place of the paper's scene, Rochester, New York.
_EMBEDDED_PLACE = ("EPSG:32618", 288000.0, 4781000.0)


class SceneDesign(BaseModel):
    """What city, from what seed, with what traffic.

    Parameters
    ----------
    city
        ``embedded``: procedural, with a shipped recording of traffic. ``braunschweig``: the real network and
        footprints in the installed SUMO wheel, driven by SUMO (extra ``traffic``).
    seed
        Of everything drawn by chance: roofs, trees, parked vehicles, paints. The traffic does not depend on
        it.
    trees
        False leaves every tree out.
    traffic_start_s
        Time of the recording that is time zero of the case. [s]
    traffic_duration_s
        Length of the recording SUMO makes for Braunschweig; the embedded one is 120 s long. [s]
    traffic_warmup_s
        SUMO time before Braunschweig's recording starts. [s]
    traffic_insertion_period_s
        One vehicle enters Braunschweig each such interval; 0.6 s keeps about 200 in the window. [s]
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    city: Literal["embedded", "braunschweig"] = "embedded"
    seed: int = Field(default=1, ge=0)
    trees: bool = True
    traffic_start_s: float = Field(default=0.0, ge=0)
    traffic_duration_s: float = Field(default=120.0, gt=0, le=3600)
    traffic_warmup_s: float = Field(default=300.0, ge=0, le=3600)
    traffic_insertion_period_s: float = Field(default=0.6, gt=0)


@dataclass(frozen=True)
class Snapshot:
    """The city at one instant.

    Parameters
    ----------
    static
        What never moves.
    models
        Vehicle meshes in their body frames: x forward, y left, z up, origin on the ground below the centre.
    transforms
        Body frame to ENU of each vehicle. [1, m]
    model, paint
        Index of each vehicle into ``models``, and of its paint into the materials.
    vehicle_id
        Stable over time; the ``vehicle`` coordinate of the truth.
    """

    static: Mesh
    models: tuple[Mesh, ...]
    transforms: Float[Array, "vehicle 3 4"]
    model: Int[Array, "vehicle"]
    paint: Int[Array, "vehicle"]
    vehicle_id: Int[Array, "vehicle"]


@dataclass(frozen=True)
class City:
    """A city with its traffic; ENU about the centre of its window.

    Parameters
    ----------
    static, models
        Meshes, see `Snapshot`.
    materials
        Dataset of schema ``materials``.
    terrain
        Dataset of schema ``terrain``: height of the ground.
    extent_m
        West, south, east, north of the window. [m]
    crs, origin_easting_m, origin_northing_m
        Projected CRS, and the place of ENU (0, 0) in it; grid north is taken as north. [m]
    latitude_deg, longitude_deg
        The same place.
    traffic
        Trajectories.
    start_s
        Time of the recording at which the case begins. [s]
    paints
        Material index of each vehicle's paint.
    """

    static: Mesh
    models: tuple[Mesh, ...]
    materials: xr.Dataset
    terrain: xr.Dataset
    extent_m: tuple[float, float, float, float]
    crs: str
    origin_easting_m: float
    origin_northing_m: float
    latitude_deg: float
    longitude_deg: float
    traffic: Traffic
    start_s: float
    paints: Int[Array, "vehicle"]

    def at(self, time_s: float) -> Snapshot:
        """The city at a time of the case. [s]."""
        ids, states = self._present(time_s)
        position = np.c_[states[:, :2], np.zeros(len(ids))]
        return Snapshot(
            static=self.static,
            models=self.models,
            transforms=body_to_enu(position, states[:, 2]),
            model=self.traffic.model[ids],
            paint=self.paints[ids],
            vehicle_id=ids,
        )

    def truth(self, time_s: float) -> xr.Dataset:
        """Where every vehicle is at a time of the case, as a Dataset of schema ``truth``.

        Positions are centres of vehicles on the ground; parked vehicles are not among them.
        """
        ids, states = self._present(time_s)
        return truth_dataset(ids, states, self.traffic.dimensions[ids])

    @cached_property
    def duration_s(self) -> float:
        """Longest time of the case the traffic covers. [s]."""
        return self.traffic.duration_s - self.start_s

    def _present(self, time_s: float) -> tuple[Int[Array, "vehicle"], Float[Array, "vehicle 5"]]:
        if not -1e-6 <= time_s <= self.duration_s + 1e-6:  # a microsecond: rounding of the clock
            raise ValueError(
                f"`time_s` must lie within the recorded traffic, 0 to {self.duration_s:g} s, got {time_s:g}"
            )
        ids, states = self.traffic.at(min(max(time_s, 0.0), self.duration_s) + self.start_s)
        west, south, east, north = self.extent_m
        near = (states[:, 0] > west - VEHICLE_MARGIN_M) & (states[:, 0] < east + VEHICLE_MARGIN_M)
        near &= (states[:, 1] > south - VEHICLE_MARGIN_M) & (states[:, 1] < north + VEHICLE_MARGIN_M)
        return ids[near], states[near]


def build_scene(design: SceneDesign) -> City:
    """Build a city and its traffic from a design.

    Parameters
    ----------
    design
        What to build; the same design gives the same bytes.

    Raises
    ------
    ValueError
        If the design starts after its traffic ends, or an extra or a system library is missing.
    """
    recording, (crs, easting, northing) = _recording(design)
    if design.traffic_start_s >= recording.traffic.duration_s:
        raise ValueError(
            f"`traffic_start_s` must lie before the recording's end at {recording.traffic.duration_s:g} s, "
            f"got {design.traffic_start_s:g}"
        )
    layout_rng, mesh_rng = np.random.default_rng(design.seed).spawn(2)
    fill = embedded_layout if design.city == "embedded" else braunschweig_layout
    layout = fill(recording.network, EXTENT_M, design.trees, layout_rng)
    materials = load_materials()
    index = material_index(materials)
    models = build_models(index)
    parked = choose_paints(materials, _PARKED_PAINT_KEY + np.arange(len(layout.parked)), design.seed)
    longitude, latitude = pyproj.Transformer.from_crs(crs, 4326, always_xy=True).transform(easting, northing)
    return City(
        static=build_mesh(layout, EXTENT_M, index, models, parked, mesh_rng),
        models=models,
        materials=materials,
        terrain=_level_terrain(),
        extent_m=EXTENT_M,
        crs=crs,
        origin_easting_m=easting,
        origin_northing_m=northing,
        latitude_deg=latitude,
        longitude_deg=longitude,
        traffic=recording.traffic,
        start_s=design.traffic_start_s,
        paints=choose_paints(materials, np.arange(recording.traffic.first.size), design.seed),
    )


def _recording(design: SceneDesign) -> tuple[Recording, tuple[str, float, float]]:
    """Network and traffic of a design, and the CRS, easting and northing of its origin."""
    if design.city == "embedded":
        return embedded_recording(), _EMBEDDED_PLACE
    return braunschweig_recording(
        EXTENT_M,
        VEHICLE_MARGIN_M,
        design.traffic_warmup_s,
        design.traffic_start_s + design.traffic_duration_s,
        design.traffic_insertion_period_s,
    )


def _level_terrain() -> xr.Dataset:
    west, south, east, north = EXTENT_M
    x = np.arange(west - MARGIN_M, east + MARGIN_M + 1, _TERRAIN_STEP_M)
    y = np.arange(north + MARGIN_M, south - MARGIN_M - 1, -_TERRAIN_STEP_M)
    terrain = xr.Dataset(
        {"height": (("y", "x"), np.zeros((y.size, x.size)), {"units": "m"})},
        coords={"y": ("y", y, {"units": "m"}), "x": ("x", x, {"units": "m"})},
    )
    return schema.check(terrain, "terrain")
