"""Design of a city, its files, seed and traffic: the ``[scene]`` table of a case."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from shapely import Polygon

from glintrack.core.designs import Design
from glintrack.core.installation import read_data
from glintrack.core.records import Extent
from glintrack.io.untrusted import resolve_path

DEFAULT_SIZE_M = (660.0, 420.0)  # of the embedded tile, whose traffic is shipped
LARGEST_M2 = 4e6
LARGEST_SIDE_M = 20_000.0
MAX_CORNERS = 1000
DEFAULT_RELIEF_M = 6.0
SHIPPED_DURATION_S = 120.0
SUMO_PREFIX = "sumo:"
_FILES = tuple(f"{name}_file" for name in ("net", "polygons", "osm", "mesh", "materials", "dem", "traffic"))
_ONLY_FOR: Mapping[str, Sequence[str]] = read_data("cities.toml")["only_for"]
_NEEDED = {"net": "net_file", "osm": "osm_file", "mesh": "mesh_file"}

FileName = Annotated[str, Field(min_length=1)]
Coordinate = Annotated[float, Field(ge=-1e7, le=1e7)]


class PanelDesign(Design):
    """A calibration panel on the ground; one ``[[scene.panels]]`` table of a case."""

    material: str
    """Material of the library: panel_05, panel_20, panel_50 and panel_80 are Lambertian; glass and paints
    have their interface."""
    east_m: Coordinate
    """Easting of its centre, ENU."""
    north_m: Coordinate
    """Northing of its centre, ENU."""
    length_m: float = Field(default=8.0, gt=0, le=200)
    """Length along its heading."""
    width_m: float = Field(default=8.0, gt=0, le=200)
    """Width across its heading."""
    heading_deg: float = Field(default=0.0, ge=-360, le=360)
    """Heading, clockwise from north."""


class SceneDesign(Design):
    """City, seed and traffic; the ``[scene]`` table of a case.

    A file name is relative to the folder of the case that names it. One that begins with ``sumo:`` is in the
    installed SUMO wheel, which has real networks: ``sumo:tools/game/DRT/osm.net.xml``.
    """

    city: Literal["embedded", "braunschweig", "net", "osm", "mesh"] = "embedded"
    """embedded: procedural, with a shipped recording of traffic; braunschweig: the real network and
    footprints in the installed SUMO wheel; net: a SUMO network; osm: an OpenStreetMap extract; mesh:
    triangles of a user. SUMO (extra `traffic`) simulates the traffic of all but the first and the last,
    unless a traffic file is given."""
    seed: int = Field(default=1, ge=0, le=2**63 - 1)
    """Seed of roofs, trees, parked vehicles and paints, and of traffic that SUMO simulates. Recorded traffic
    does not depend on it."""
    trees: float = Field(default=1.0, ge=0, le=1)
    """Share of the city's trees that are planted. `true` is all, `false` none."""
    width_m: float | None = Field(default=None, ge=50, le=LARGEST_SIDE_M)
    """Width of the window, west to east; 660 by default, for a mesh its own. An embedded city of another size
    gets its own streets, and its traffic from SUMO."""
    height_m: float | None = Field(default=None, ge=50, le=LARGEST_SIDE_M)
    """Height of the window, south to north; 420 by default, for a mesh its own. Without both
    sizes the window grows to the ground in the frame, if most of that lies beyond the city."""
    area: Literal["window", "footprint"] | tuple[tuple[Coordinate, Coordinate], ...] | None = None
    """Area whose vehicles are scored: the window, the ground of it in each frame (footprint), or a polygon of
    [east, north] corners, ENU. By default the window, or the footprint if less than 75 % of the window is in
    the frame."""
    centre_m: tuple[Coordinate, Coordinate] | None = None
    """Middle of the window in the network's coordinates; by default where the network is densest."""
    net_file: FileName | None = None
    """SUMO network, .net.xml, plain or gzipped."""
    polygons_file: FileName | None = None
    """polyconvert's polygons of that network."""
    osm_file: FileName | None = None
    """OpenStreetMap XML, .osm, plain, or in a gzip or bzip2 archive."""
    fill_blocks: bool | None = None
    """Build houses by rule on land where the files have none, except within 40 m of a motorway. By default
    only if they have none at all."""
    mesh_file: FileName | None = None
    """Triangles: .glb, .gltf, .obj, .ply or .stl."""
    mesh_up: Literal["y", "z"] | None = None
    """Axis of the mesh that points up; by default y for glTF and z for the others."""
    mesh_unit_m: float | None = Field(default=None, gt=0, le=1e4)
    """Length of the mesh's unit."""
    materials_file: FileName | None = None
    """TOML with further materials, and under [mesh] the material of each of the mesh's own."""
    polarized_bases: bool = False
    """Polarize the light of bases, for materials with a `polarized_base` (asphalt, concrete): Umov's law."""
    material_variation: float = Field(default=1.0, ge=0, le=2)
    """Scale of the variation of colour and gloss within a material and between vehicles: 1 as in the library,
    0 for none."""
    dem_file: FileName | None = None
    """Heights of the ground, any raster with a CRS that GDAL reads; the scene is draped over it."""
    left_hand: bool | None = None
    """Traffic keeps left; by default as the SUMO network says, or the country of an OpenStreetMap extract."""
    crs: str | None = None
    """Projected CRS of ENU (0, 0); for a mesh, and for networks without a projection."""
    origin_m: tuple[Coordinate, Coordinate] | None = None
    """Easting and northing of ENU (0, 0) in that CRS."""
    relief_m: float | None = Field(default=None, ge=0, le=40)
    """Height from trough to crest of the gentle hills under an embedded city, 6 by default; 0 is level."""
    panels: tuple[PanelDesign, ...] = ()
    """Calibration panels."""
    traffic_file: FileName | None = None
    """Floating-car data (SUMO's FCD as XML, CSV or Parquet) in the network's coordinates, or in ENU for an
    embedded city or a mesh; or in degrees, for a city with a place."""
    traffic_duration_s: float = Field(default=120.0, gt=0, le=3600)
    """Length of the recording SUMO makes; the shipped one is 120 s long, and SUMO simulates a longer one."""
    traffic_insertion_period_s: float | None = Field(default=None, ge=0.01, le=3600)
    """One vehicle enters each such interval; by default 0.6 s for Braunschweig, which keeps about 200 in the
    window, and as many a kilometre of lane elsewhere."""

    @model_validator(mode="after")
    def _keys_belong_together(self) -> Self:
        for key, cities in _ONLY_FOR.items():
            if getattr(self, key) is not None and self.city not in cities:
                raise ValueError(
                    f"`scene.{key}` must be given with city = {' or '.join(map(repr, cities))} only; "
                    f"got city = {self.city!r}."
                )
        needed = _NEEDED.get(self.city)
        if needed and getattr(self, needed) is None:
            raise ValueError(f"`scene.{needed}` must be given with city = {self.city!r}; got none.")
        wide, high = self.size_m
        if wide * high > LARGEST_M2:
            raise ValueError(
                f"`scene.width_m` × `scene.height_m` must be at most {LARGEST_M2 / 1e6:g} km²; "
                f"got {wide * high / 1e6:.3g} km²."
            )
        if (self.crs is None) != (self.origin_m is None):
            raise ValueError(
                "`scene.crs` and `scene.origin_m` must be given together; "
                f"got {self.crs} and {self.origin_m}."
            )
        if isinstance(self.area, tuple):
            shape = Polygon(self.area) if 3 <= len(self.area) <= MAX_CORNERS else Polygon()
            if not (shape.is_valid and shape.area):
                raise ValueError(
                    f"`scene.area` must have 3 to {MAX_CORNERS:,} corners in their order around an area; "
                    f"got {len(self.area):,} that bound none."
                )
        if self.relief_m and (self.dem_file or self.city != "embedded"):
            raise ValueError("`scene.relief_m` must be 0 but for an embedded city without a dem_file")
        if self.city == "braunschweig" and self.size_m != DEFAULT_SIZE_M:
            raise ValueError(
                "`scene.width_m` and `scene.height_m` must be 660 and 420 for city = 'braunschweig'; "
                f"got {wide:g} and {high:g}. With city = 'net' any window is possible."
            )
        return self

    @property
    def size_m(self) -> tuple[float, float]:
        """Window's width and height, the defaults where none is given. [m]"""
        return self.width_m or DEFAULT_SIZE_M[0], self.height_m or DEFAULT_SIZE_M[1]

    @property
    def uses_mesh_window(self) -> bool:
        """Return True if the window is that of a mesh, whatever `size_m` is."""
        return self.city == "mesh" and self.width_m is None and self.height_m is None

    @property
    def uses_shipped_traffic(self) -> bool:
        """Return True if an embedded city of this design uses the shipped recording."""
        longer = self.traffic_duration_s > SHIPPED_DURATION_S
        simulated = longer or self.traffic_insertion_period_s is not None
        return self.size_m == DEFAULT_SIZE_M and not (self.traffic_file is None and simulated)

    @property
    def uses_recorded_traffic(self) -> bool:
        """Return True if the traffic does not depend on the seed: a file, or the shipped recording."""
        return bool(self.traffic_file) or (self.city == "embedded" and self.uses_shipped_traffic)

    @property
    def recording_duration_s(self) -> float:
        """Duration of the traffic recording, without a traffic file of the user's. [s]"""
        shipped = self.city == "embedded" and self.uses_shipped_traffic
        return SHIPPED_DURATION_S if shipped else self.traffic_duration_s

    @property
    def hills_m(self) -> float:
        """Relief of the procedural ground; 0 where the data have their own ground. [m]"""
        if self.relief_m is not None:
            return self.relief_m
        return DEFAULT_RELIEF_M if self.city == "embedded" and not self.dem_file else 0.0

    @property
    def extent_m(self) -> Extent:
        """Extent of the window in ENU. [m]"""
        wide, high = self.size_m
        return Extent(-wide / 2, -high / 2, wide / 2, high / 2)

    @property
    def uses_files(self) -> bool:
        """Return True if the city needs files of the user's."""
        return any(getattr(self, name) is not None for name in _FILES)

    def resolve_files(self, folder: Path) -> "SceneDesign":
        """Resolve relative file names from a folder."""
        return self._replace_files(lambda name: str(resolve_path(folder / name)))

    def with_relative_files(self, folder: Path) -> "SceneDesign":
        """Make the names of files in a folder and below relative to it, so that both may move."""
        root = resolve_path(folder)

        def rename(name: str) -> str:
            return Path(name).relative_to(root).as_posix() if Path(name).is_relative_to(root) else name

        return self._replace_files(rename)

    def _replace_files(self, rename: Callable[[str], str]) -> "SceneDesign":
        names = {name: getattr(self, name) for name in _FILES}
        own = {name: v for name, v in names.items() if v is not None and not v.startswith(SUMO_PREFIX)}
        return self.model_copy(update={name: rename(value) for name, value in own.items()})
