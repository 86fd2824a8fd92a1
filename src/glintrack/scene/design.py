"""Design of a city, its files, seed and traffic: the ``[scene]`` table of a case."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from glintrack.core.designs import Design
from glintrack.core.records import Extent
from glintrack.io.untrusted import resolve_path

DEFAULT_SIZE_M = (660.0, 420.0)  # of the embedded tile, whose traffic is shipped
LARGEST_M2 = 4e6
DEFAULT_RELIEF_M = 6.0
SHIPPED_DURATION_S = 120.0
SUMO_PREFIX = "sumo:"
_FILES = (
    "net_file",
    "polygons_file",
    "osm_file",
    "mesh_file",
    "materials_file",
    "dem_file",
    "traffic_file",
)
# keys that belong to some cities only; every other key is for all of them
_ONLY_FOR = {
    "net_file": ("net",),
    "polygons_file": ("net",),
    "osm_file": ("osm",),
    "mesh_file": ("mesh",),
    "mesh_up": ("mesh",),
    "mesh_unit_m": ("mesh",),
    "centre_m": ("net", "osm"),
    "crs": ("net", "osm", "mesh"),
    "traffic_file": ("embedded", "net", "osm", "mesh"),
}
_NEEDED = {"net": "net_file", "osm": "osm_file", "mesh": "mesh_file"}

FileName = Annotated[str, Field(min_length=1)]


Coordinate = Annotated[float, Field(ge=-1e7, le=1e7)]


class PanelDesign(Design):
    """A calibration panel that lies on the ground; one ``[[scene.panels]]`` table of a case."""

    material: str
    """Any of the library's: panel_05, panel_20, panel_50 and panel_80 are Lambertian; glass and paints have
    their interface."""
    east_m: Coordinate
    """Of its centre, ENU."""
    north_m: Coordinate
    """Of its centre, ENU."""
    length_m: float = Field(default=8.0, gt=0, le=200)
    """Along its heading."""
    width_m: float = Field(default=8.0, gt=0, le=200)
    """Across its heading."""
    heading_deg: float = Field(default=0.0, ge=-360, le=360)
    """Clockwise from north."""


class SceneDesign(Design):
    """What city, from what seed, with what traffic; the ``[scene]`` table of a case.

    A file name is looked up from the folder of the case that names it; one that begins with ``sumo:`` is
    looked up in the installed SUMO wheel, where real networks lie: ``sumo:tools/game/DRT/osm.net.xml``.
    """

    city: Literal["embedded", "braunschweig", "net", "osm", "mesh"] = "embedded"
    """embedded: procedural, with a shipped recording of traffic; braunschweig: the real network and
    footprints in the installed SUMO wheel; net: a SUMO network; osm: an OpenStreetMap extract; mesh:
    triangles made elsewhere. All but the first and the last are driven by SUMO (extra `traffic`) unless a
    traffic file is given."""
    seed: int = Field(default=1, ge=0, le=2**63 - 1)
    """Of everything drawn by chance: roofs, trees, parked vehicles, paints; not of the traffic."""
    trees: float = Field(default=1.0, ge=0, le=1)
    """Share of the city's trees that are planted; all else stays as it is. `true` is all, `false` none."""
    width_m: float | None = Field(default=None, ge=50, le=20000)
    """Of the window, west to east; 660 by default, for a mesh its own. An embedded city of another size gets
    its own streets, and its traffic from SUMO."""
    height_m: float | None = Field(default=None, ge=50, le=20000)
    """Of the window, south to north; 420 by default, for a mesh its own."""
    centre_m: tuple[Coordinate, Coordinate] | None = None
    """Middle of the window in the network's coordinates; by default where the network is densest."""
    net_file: FileName | None = None
    """SUMO network, .net.xml, plain or gzipped."""
    polygons_file: FileName | None = None
    """polyconvert's polygons of that network."""
    osm_file: FileName | None = None
    """OpenStreetMap XML, .osm, plain or gzipped."""
    mesh_file: FileName | None = None
    """Triangles: .glb, .gltf, .obj, .ply or .stl."""
    mesh_up: Literal["y", "z"] | None = None
    """Which of the mesh's axes is up; by default y for glTF and z for the others."""
    mesh_unit_m: float | None = Field(default=None, gt=0, le=1e4)
    """Length of the mesh's unit."""
    materials_file: FileName | None = None
    """TOML with further materials, and under [mesh] the material of each of the mesh's own."""
    polarized_bases: bool = False
    """Polarize what bases scatter, of materials with a `polarized_base` (asphalt, concrete): Umov's law."""
    dem_file: FileName | None = None
    """Heights of the ground, any raster with a CRS that GDAL reads; the scene is draped over it."""
    crs: str | None = None
    """Projected CRS in which ENU (0, 0) lies; for a mesh, and for networks without a projection."""
    origin_m: tuple[Coordinate, Coordinate] | None = None
    """Easting and northing of ENU (0, 0) in that CRS."""
    relief_m: float | None = Field(default=None, ge=0, le=40)
    """Height from trough to crest of the gentle hills under an embedded city, 6 by default; 0 is level."""
    panels: tuple[PanelDesign, ...] = ()
    """Calibration panels."""
    traffic_file: FileName | None = None
    """Floating-car data (SUMO's FCD as XML, CSV or Parquet) in the network's coordinates, or in ENU for an
    embedded city or a mesh."""
    traffic_duration_s: float = Field(default=120.0, gt=0, le=3600)
    """Length of the recording SUMO makes; the embedded one is 120 s long, and SUMO drives for a longer."""
    traffic_insertion_period_s: float | None = Field(default=None, ge=0.01, le=3600)
    """One vehicle enters each such interval; by default 0.6 s for Braunschweig, which keeps about 200 in the
    window, and as many a kilometre of lane elsewhere."""

    @model_validator(mode="after")
    def _keys_belong_together(self) -> Self:
        for key, cities in _ONLY_FOR.items():
            if getattr(self, key) is not None and self.city not in cities:
                raise ValueError(
                    f"`scene.{key}` must be given with city = {' or '.join(map(repr, cities))} only, "
                    f"got city = {self.city!r}"
                )
        needed = _NEEDED.get(self.city)
        if needed and getattr(self, needed) is None:
            raise ValueError(f"`scene.{needed}` must be given with city = {self.city!r}, got none")
        wide, high = self.size_m
        if wide * high > LARGEST_M2:
            raise ValueError(
                f"`scene.width_m` × `scene.height_m` must be at most {LARGEST_M2 / 1e6:g} km², "
                f"got {wide * high / 1e6:.3g} km²"
            )
        if (self.crs is None) != (self.origin_m is None):
            raise ValueError(
                f"`scene.crs` and `scene.origin_m` must be given together, got {self.crs} and {self.origin_m}"
            )
        if self.relief_m and (self.dem_file or self.city != "embedded"):
            raise ValueError("`scene.relief_m` must be 0 but for an embedded city without a dem_file")
        if self.city == "braunschweig" and self.size_m != DEFAULT_SIZE_M:
            raise ValueError(
                "`scene.width_m` and `scene.height_m` must be 660 and 420 for city = 'braunschweig', "
                f"got {wide:g} and {high:g} (city = 'net' takes any window)"
            )
        return self

    @property
    def size_m(self) -> tuple[float, float]:
        """Window's width and height, the defaults where none is given. [m]."""
        return self.width_m or DEFAULT_SIZE_M[0], self.height_m or DEFAULT_SIZE_M[1]

    @property
    def window_is_the_meshs(self) -> bool:
        """Whether the window is as large as a mesh that has not been read yet, whatever `size_m` says."""
        return self.city == "mesh" and self.width_m is None and self.height_m is None

    @property
    def own_traffic(self) -> bool:
        """Whether SUMO must drive although a recording is shipped."""
        longer = self.traffic_duration_s > SHIPPED_DURATION_S
        return self.traffic_file is None and (longer or self.traffic_insertion_period_s is not None)

    @property
    def recorded_s(self) -> float:
        """From time zero of the case to the recording's end, where no file of the user's has it. [s]."""
        shipped = self.city == "embedded" and self.ships_traffic
        return SHIPPED_DURATION_S if shipped else self.traffic_duration_s

    @property
    def ships_traffic(self) -> bool:
        """Whether the embedded tile's own recording drives in an embedded city."""
        return self.size_m == DEFAULT_SIZE_M and not self.own_traffic

    @property
    def hills_m(self) -> float:
        """Relief of the ground drawn by rule; 0 where the data bring their own ground. [m]."""
        if self.relief_m is not None:
            return self.relief_m
        return DEFAULT_RELIEF_M if self.city == "embedded" and not self.dem_file else 0.0

    @property
    def extent_m(self) -> Extent:
        """The window in ENU. [m]."""
        wide, high = self.size_m
        return Extent(-wide / 2, -high / 2, wide / 2, high / 2)

    @property
    def names_files(self) -> bool:
        """Whether the city comes from files of the user's."""
        return any(getattr(self, name) is not None for name in _FILES)

    def located(self, folder: Path) -> "SceneDesign":
        """The same design with relative file names taken from a folder."""
        names = {name: getattr(self, name) for name in _FILES}
        found = {
            name: str(resolve_path(folder / value))
            for name, value in names.items()
            if value is not None and not value.startswith(SUMO_PREFIX)
        }
        return self.model_copy(update=found) if found else self

    def beside(self, folder: Path) -> "SceneDesign":
        """The same design with files in a folder and below named from it, so that both may move."""
        names = {name: getattr(self, name) for name in _FILES}
        root = resolve_path(folder)
        found = {
            name: Path(value).relative_to(root).as_posix()
            for name, value in names.items()
            if value is not None and not value.startswith(SUMO_PREFIX) and Path(value).is_relative_to(root)
        }
        return self.model_copy(update=found) if found else self
