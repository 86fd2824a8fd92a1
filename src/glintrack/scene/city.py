"""The city: what stands, what moves, and where everything is at any time."""

import difflib
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from shapely.affinity import rotate, translate
from shapely.geometry import Point, box
from shapely.ops import unary_union

from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.io.gltf import Document
from glintrack.scene.design import DEFAULT_SIZE_M, SceneDesign
from glintrack.scene.materials import choose_paints, extended_library, load_materials, material_index
from glintrack.scene.objects.geometry import PAINT, Mesh, MeshBuilder
from glintrack.scene.objects.layout import (
    MARGIN_M,
    Instances,
    Layout,
    Panel,
    add_panel,
    body_to_enu,
    build_mesh,
    grown,
    no_instances,
    place_instances,
)
from glintrack.scene.objects.plants import hedge_model, tree_models
from glintrack.scene.objects.terrain import (
    is_level,
    level_terrain,
    read_dem,
    rolling_terrain,
    slope_at,
)
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.read.sumo import shifted
from glintrack.scene.sources.braunschweig import braunschweig_layout, braunschweig_recording
from glintrack.scene.sources.embedded import drawn_recording, embedded_layout, embedded_recording
from glintrack.scene.sources.site import (
    ROCHESTER,
    VEHICLE_MARGIN_M,
    SceneOrigin,
    Site,
    mesh_site,
    mesh_terrain,
)
from glintrack.scene.sources.user_network import network_site, resolve_file
from glintrack.scene.traffic import Recording, Traffic, truth_dataset, warn_of_jam
from glintrack.scene.vehicles import build_models

MOST_TREES = 60_000  # each is an instance of some hundred bytes here and about a thousand in the ray tracer
BRAUNSCHWEIG_PERIOD_S = 0.6
_PARKED_PAINT_KEY = 1_000_000  # parked vehicles draw their paints from other keys than driving ones
_RELIEF_KEY = 7  # hills are drawn from other numbers than buildings


@dataclass(frozen=True)
class Snapshot:
    """The city at one instant.

    Parameters
    ----------
    static
        What never moves.
    models
        Meshes of vehicles (and of whatever else stands in several places) in their body frames: x forward,
        y left, z up, origin on the ground below the centre.
    transforms
        Body frame to ENU of each instance: a rotation, times a uniform scale for what may be scaled. [1, m]
    model, paint
        Index of each instance into ``models``, and of its paint into the materials.
    vehicle_id
        Stable over time; the ``vehicle`` coordinate of the truth. −1 for an instance that is no vehicle of
        the truth.
    fixed
        How many instances, from the first on, never move (trees, parked vehicles): the same in every snapshot
        of a city.
    """

    static: Mesh
    models: tuple[Mesh, ...]
    transforms: Float[Array, "vehicle 3 4"]
    model: Int[Array, "vehicle"]
    paint: Int[Array, "vehicle"]
    vehicle_id: Int[Array, "vehicle"]
    fixed: int = 0

    def without_traffic(self) -> "Snapshot":
        """The same instant with what never moves alone."""
        kept = slice(0, self.fixed)
        instances = {n: getattr(self, n)[kept] for n in ("transforms", "model", "paint", "vehicle_id")}
        return replace(self, **instances)


@dataclass(frozen=True)
class City:
    """A city with its traffic; ENU about the centre of its window.

    Parameters
    ----------
    static, models
        Meshes, see `Snapshot`; the models of vehicles come first, then a hedge, then trees.
    planted
        Trees, hedges and parked vehicles.
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
    paints
        Material index of each vehicle's paint.
    origin_height_m
        Height of ENU (0, 0, 0) in the terrain raster's datum. [m]
    assumptions
        What was guessed because the data do not say, one sentence each.
    lanes
        Centre lines on which cars drive, as a road map has them. [m]
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
    paints: Int[Array, "vehicle"]
    planted: Instances
    origin_height_m: float = 0.0
    assumptions: tuple[str, ...] = ()
    lanes: tuple[Float[Array, "point 2"], ...] = ()

    def at(self, time_s: float) -> Snapshot:
        """The city at a time of the case. [s]."""
        ids, states = self._present(time_s)
        position = np.c_[states[:, :2], self._ground(states)]
        slope = None if self._level else slope_at(self.terrain, states[:, 0], states[:, 1])
        planted = self.planted
        return Snapshot(
            static=self.static,
            models=self.models,
            transforms=np.concatenate([planted.transforms, body_to_enu(position, states[:, 2], slope)]),
            model=np.concatenate([planted.model, self.traffic.model[ids]]),
            paint=np.concatenate([planted.paint, self.paints[ids]]),
            vehicle_id=np.concatenate([np.full(len(planted), -1), ids]),
            fixed=len(planted),
        )

    def truth(self, time_s: float) -> xr.Dataset:
        """Where every vehicle is at a time of the case, as a Dataset of schema ``truth``.

        Positions are centres of vehicles on the ground; parked vehicles are not among them. ``pitch`` is that
        of the ground under the vehicle, nose up positive; ``inside`` and ``moving`` are 1 or 0.
        """
        ids, states = self._present(time_s)
        slope = slope_at(self.terrain, states[:, 0], states[:, 1])
        rise = np.sin(states[:, 2]) * slope[:, 0] + np.cos(states[:, 2]) * slope[:, 1]
        dimensions = self.traffic.dimensions[ids]
        up = self._ground(states)
        return truth_dataset(ids, states, dimensions, up, np.arctan(rise), self.extent_m)

    @cached_property
    def duration_s(self) -> float:
        """Longest time of the case the traffic covers. [s]."""
        return self.traffic.duration_s

    @cached_property
    def _level(self) -> bool:
        return is_level(self.terrain)

    def _ground(self, states: Float[Array, "vehicle 5"]) -> Float[Array, "vehicle"]:
        """Height of the ground under vehicles. [m]"""
        return height_at(self.terrain, states[:, 0], states[:, 1])

    def _present(self, time_s: float) -> tuple[Int[Array, "vehicle"], Float[Array, "vehicle 5"]]:
        if not -1e-6 <= time_s <= self.duration_s + 1e-6:  # a microsecond: rounding of the clock
            raise ValueError(
                f"`time_s` must lie within the recorded traffic, 0 to {self.duration_s:g} s, got {time_s:g}"
            )
        ids, states = self.traffic.at(min(max(time_s, 0.0), self.duration_s))
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
        If a file is missing or bad, the design starts after its traffic ends, or an extra or a system library
        is missing.
    """
    library, mesh_materials = load_materials(design.polarized_bases), {}
    if design.materials_file:
        library, mesh_materials = extended_library(
            resolve_file(design.materials_file), design.polarized_bases
        )
    index = material_index(library)
    site = _site(design)
    panels = _panels(design, index, site.extent_m)  # a mesh's window is its own
    traffic = site.recording.traffic
    warn_of_jam(traffic, site.extent_m)
    layout_rng, mesh_rng = np.random.default_rng(design.seed).spawn(2)
    terrain, origin_height_m = _terrain(design, site)
    vehicles = build_models(index)
    if site.mesh is not None:
        static = _joined(site.mesh.mesh(mesh_materials, index), panels, index, terrain)
        planted, said = no_instances(), ()
    else:
        layout, said = _planned(site, design.trees, panels, layout_rng)
        keys = _PARKED_PAINT_KEY + np.arange(len(layout.parked))
        parked = choose_paints(library, keys, design.seed)
        ground = None if is_level(terrain) else terrain
        tree_rng, building_rng = mesh_rng.spawn(2)  # so that a city without trees has the same buildings
        static = build_mesh(layout, site.extent_m, index, building_rng, ground)
        planted = place_instances(layout, parked, index, len(vehicles), tree_rng, ground)
    longitude, latitude = site.place.longitude_latitude_deg
    return City(
        static=static,
        models=(*vehicles, hedge_model(index), *tree_models(index)),
        materials=library,
        terrain=terrain,
        extent_m=site.extent_m,
        crs=site.place.crs,
        origin_easting_m=site.place.easting_m,
        origin_northing_m=site.place.northing_m,
        latitude_deg=latitude,
        longitude_deg=longitude,
        traffic=traffic,
        paints=choose_paints(library, np.arange(traffic.first.size), design.seed),
        planted=planted,
        origin_height_m=origin_height_m,
        assumptions=site.assumptions + said,
        lanes=tuple(lane.points for lane in site.recording.network.of_kind("car", "internal")),
    )


def record_traffic(design: SceneDesign) -> Recording:
    """Streets and traffic of a design, where its ``traffic_file`` would have them.

    Parameters
    ----------
    design
        What to drive on, for how long and how densely; what stands there is not built.

    Returns
    -------
    In network coordinates for city ``net`` and ``osm``, else in ENU. [m]
    """
    site = _site(design)
    east, north = site.traffic_origin_m
    return Recording(
        site.recording.network.shifted(east, north), shifted(site.recording.traffic, east, north)
    )


def _site(design: SceneDesign) -> Site:
    match design.city:
        case "embedded":
            return _embedded_site(design)
        case "braunschweig":
            recording, place = braunschweig_recording(
                design.extent_m,
                VEHICLE_MARGIN_M,
                design.traffic_duration_s,
                design.traffic_insertion_period_s or BRAUNSCHWEIG_PERIOD_S,
            )
            fill = partial(braunschweig_layout, recording.network, design.extent_m)
            return Site(recording, SceneOrigin(*place), design.extent_m, fill)
        case "mesh":
            return mesh_site(design)
        case _:
            return network_site(design)


def _embedded_site(design: SceneDesign) -> Site:
    shipped = design.size_m == DEFAULT_SIZE_M
    said: tuple[str, ...] = ()
    if design.ships_traffic:
        recording = embedded_recording()
    else:
        recording = drawn_recording(
            design.extent_m,
            VEHICLE_MARGIN_M,
            design.seed,
            design.traffic_duration_s,
            design.traffic_insertion_period_s,
            shipped,
        )
    if design.traffic_file:
        traffic, odd = read_fcd(resolve_file(design.traffic_file), grown(design.extent_m, VEHICLE_MARGIN_M))
        recording, said = replace(recording, traffic=traffic), odd.sentences()
    fill = partial(embedded_layout, recording.network, design.extent_m, shipped=shipped)
    return Site(recording, ROCHESTER, design.extent_m, fill, assumptions=said)


def _panels(
    design: SceneDesign, index: dict[str, int], extent_m: tuple[float, float, float, float]
) -> tuple[Panel, ...]:
    found = []
    for k, panel in enumerate(design.panels):
        if panel.material not in index:
            near = difflib.get_close_matches(panel.material, index, n=1)
            remedy = f" (did you mean {near[0]!r}?)" if near else ""
            raise ValueError(
                f"`scene.panels.{k}.material` must be one of the library, got {panel.material!r}{remedy}"
            )
        half_width, half_length = panel.width_m / 2, panel.length_m / 2
        slab = rotate(box(-half_width, -half_length, half_width, half_length), -panel.heading_deg)
        placed = translate(slab, panel.east_m, panel.north_m)
        if not placed.intersects(box(*extent_m)):
            west, south, east, north = extent_m
            raise ValueError(
                f"`scene.panels.{k}` must lie in the window, east {west:g} to {east:g} m and north {south:g} "
                f"to {north:g} m, got {panel.east_m:g} and {panel.north_m:g} m (from the window's middle)"
            )
        found.append(Panel(panel.material, placed))
    return tuple(found)


def _terrain(design: SceneDesign, site: Site) -> tuple[xr.Dataset, float]:
    """Ground height under the window and its margin, and the datum of its zero. [m]"""
    bounds = grown(site.extent_m, MARGIN_M)
    if design.dem_file:
        origin = site.place.easting_m, site.place.northing_m
        return read_dem(resolve_file(design.dem_file), bounds, site.place.crs, origin)
    if design.hills_m:
        rng = np.random.default_rng((design.seed, _RELIEF_KEY))
        return rolling_terrain(bounds, design.hills_m, rng), 0.0
    if site.mesh is not None:
        return mesh_terrain(site.mesh, bounds), 0.0
    return level_terrain(bounds), 0.0


def _planned(
    site: Site, share: float, panels: tuple[Panel, ...], rng: np.random.Generator
) -> tuple[Layout, tuple[str, ...]]:
    """The city in plan: a share of its trees, no more than a scene carries, and nothing on the panels."""
    if site.layout is None:
        raise ValueError("`site` must have a layout or a mesh, got neither")
    layout = site.layout(rng)
    layout = _thinned(layout, round(share * len(layout.trees)), rng)
    said: tuple[str, ...] = ()
    if len(layout.trees) > MOST_TREES:
        said = (f"{MOST_TREES} of {len(layout.trees)} trees are kept, evenly thinned",)
        layout = _thinned(layout, MOST_TREES, rng)
    if panels:
        free = unary_union([p.shape.buffer(1.0) for p in panels])
        layout = replace(
            layout,
            panels=panels,
            trees=tuple(
                t for t in layout.trees if free.distance(Point(t.east_m, t.north_m)) > t.crown_radius_m
            ),
            parked=tuple(v for v in layout.parked if free.distance(Point(v.east_m, v.north_m)) > 3.0),
            hedges=tuple(h for h in layout.hedges if free.distance(Point(h.east_m, h.north_m)) > 1.5),
        )
    return layout, said


def _thinned(layout: Layout, count: int, rng: np.random.Generator) -> Layout:
    """The same city with so many of its trees, drawn evenly."""
    if count >= len(layout.trees):
        return layout
    kept = np.sort(rng.permutation(len(layout.trees))[:count])
    return replace(layout, trees=tuple(layout.trees[k] for k in kept))


def _joined(mesh: Mesh, panels: tuple[Panel, ...], index: dict[str, int], terrain: xr.Dataset) -> Mesh:
    if not panels:
        return mesh
    builder = MeshBuilder(index)
    builder.add_mesh(mesh, np.eye(3, 4), 0)
    for panel in panels:
        add_panel(builder, panel, terrain)
    return builder.mesh()


def glb(snapshot: Snapshot, materials: xr.Dataset) -> bytes:
    """Encode a city at one instant as glTF 2.0 binary, the bytes of a ``.glb`` file.

    Cars and trees are instances of their models. Colours are the materials' preview colours, glossy where the
    material has an interface; spectra and polarization have no place there.

    Parameters
    ----------
    snapshot
        From `City.at`.
    materials
        The city's library.
    """
    document = Document()
    rgb = materials["preview_rgb"].values
    rough, gloss, metal = (
        materials[name].values for name in ("roughness", "specular_weight", "extinction_index")
    )
    for k, name in enumerate(materials["material"].values):
        roughness = float(np.clip(np.sqrt(rough[k]) if gloss[k] > 0.2 else 1.0, 0.05, 1))
        document.add_material(str(name), rgb[k], 1.0 if metal[k] > 1 else 0.0, roughness)
    document.add_node("ground and buildings", _add_to_document(document, snapshot.static, "static"))
    made: dict[tuple[int, int], int] = {}
    for model, paint, transform, vehicle in zip(
        snapshot.model, snapshot.paint, snapshot.transforms, snapshot.vehicle_id, strict=True
    ):
        key = int(model), int(paint)
        if key not in made:
            made[key] = _add_to_document(document, snapshot.models[key[0]], f"model {key[0]}", key[1])
        name = f"vehicle {int(vehicle)}" if vehicle >= 0 else "planted"
        document.add_node(name, made[key], transform)
    return document.bytes("ENU")


def _add_to_document(document: Document, mesh: Mesh, name: str, paint: int = 0) -> int:
    """A mesh of the scene, its paint filled in; its number."""
    material = np.where(mesh.material == PAINT, paint, mesh.material)
    return document.add_mesh(mesh.vertices, mesh.faces, material, name)
