"""Build a city from a design, and evaluate its meshes, instances and traffic at any time."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from shapely.affinity import rotate, translate
from shapely.geometry import Point, box
from shapely.ops import unary_union

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.designs import suggest_name
from glintrack.core.interpolation import height_at
from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.io.gltf import Document
from glintrack.scene.design import SceneDesign
from glintrack.scene.materials import choose_paints, load_materials, load_user_materials, material_index
from glintrack.scene.objects import layout as layouts
from glintrack.scene.objects.geometry import PAINT, Mesh, MeshBuilder
from glintrack.scene.objects.plants import hedge_model, tree_models
from glintrack.scene.objects.terrain import flat_terrain, is_level, read_dem, rolling_terrain, slope_at
from glintrack.scene.sources.braunschweig import braunschweig_site
from glintrack.scene.sources.embedded import procedural_site
from glintrack.scene.sources.site import (
    VEHICLE_MARGIN_M,
    Site,
    mesh_datum_m,
    mesh_site,
    mesh_terrain,
    resolve_file,
)
from glintrack.scene.sources.user_network import network_site
from glintrack.scene.traffic import Recording, Traffic, warn_of_jam
from glintrack.scene.vehicles import VEHICLE_CLASSES, build_models

MAX_TREES = 60_000  # each is an instance of some hundred bytes here and about a thousand in the ray tracer
_PARKED_PAINT_KEY = 1_000_000  # parked vehicles draw their paints from other keys than driving ones
_RELIEF_KEY = 7  # hills are drawn from other numbers than buildings
SITES = {
    **{"embedded": procedural_site, "braunschweig": braunschweig_site},
    **{"net": network_site, "osm": network_site, "mesh": mesh_site},
}


@dataclass(frozen=True)
class Snapshot:
    """The city at one instant.

    Parameters
    ----------
    static
        Ground, buildings and panels.
    models
        Meshes of vehicles, hedges and trees in their body frames: x forward, y left, z up, origin on the
        ground below the centre.
    transforms
        Body frame to ENU of each instance: a rotation, times a uniform scale for what may be scaled. [1, m]
    model, paint
        Index of each instance into ``models``, and of its paint into the materials.
    vehicle_id
        Stable over time; the ``vehicle`` coordinate of the truth. −1 for other instances.
    fixed
        Number of leading instances that never move (trees, hedges, parked vehicles), the same in every
        snapshot of a city.
    """

    static: Mesh
    models: tuple[Mesh, ...]
    transforms: Float[Array, "vehicle 3 4"]
    model: Int[Array, "vehicle"]
    paint: Int[Array, "vehicle"]
    vehicle_id: Int[Array, "vehicle"]
    fixed: int = 0

    @property
    def parked(self) -> Int[Array, "parked"]:
        """Instances that are parked vehicles."""
        return np.flatnonzero(np.asarray(self.model)[: self.fixed] < len(VEHICLE_CLASSES))

    def without_traffic(self) -> "Snapshot":
        """Return the snapshot with only its fixed instances."""
        names = ("transforms", "model", "paint", "vehicle_id")
        return replace(self, **{name: getattr(self, name)[: self.fixed] for name in names})


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
        Projected CRS, and the position of ENU (0, 0) in it; grid north is taken as north. [m]
    latitude_deg, longitude_deg
        Position of ENU (0, 0).
    traffic
        Trajectories.
    paints
        Material index of each vehicle's paint.
    origin_height_m
        Height of ENU (0, 0, 0) in the terrain raster's datum. [m]
    assumptions
        Assumptions made where the data are incomplete, one sentence each.
    lanes
        Centre lines of the lanes for cars. [m]
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
    planted: layouts.Instances
    origin_height_m: float = 0.0
    assumptions: tuple[str, ...] = ()
    lanes: tuple[Float[Array, "point 2"], ...] = ()

    def at(self, time_s: float) -> Snapshot:
        """Evaluate the city at a time of the case. [s]"""
        ids, states = self._present(time_s)
        position = np.c_[states[:, :2], height_at(self.terrain, states[:, 0], states[:, 1])]
        slope = None if is_level(self.terrain) else slope_at(self.terrain, states[:, 0], states[:, 1])
        planted = self.planted
        return Snapshot(
            static=self.static,
            models=self.models,
            transforms=np.concatenate(
                [planted.transforms, layouts.body_to_enu(position, states[:, 2], slope)]
            ),
            model=np.concatenate([planted.model, self.traffic.model[ids]]),
            paint=np.concatenate([planted.paint, self.paints[ids]]),
            vehicle_id=np.concatenate([np.full(len(planted), -1), ids]),
            fixed=len(planted),
        )

    def truth(self, time_s: float) -> xr.Dataset:
        """Evaluate the true state of every vehicle at a time of the case, as a Dataset of schema ``truth``.

        Positions are centres of vehicles on the ground; parked vehicles are not among them. ``pitch_rad``
        is the slope of the ground along the heading, nose up positive. ``class`` is one of `VEHICLE_CLASSES`.
        ``inside`` is True within the window, ``moving`` from 1 m s⁻¹.
        """
        ids, states = self._present(time_s)
        x, y, heading, *speed = states.T
        slope = slope_at(self.terrain, x, y)
        length, width, height = self.traffic.dimensions[ids].T
        west, south, east, north = self.extent_m
        columns = {
            "east_m": (x, "m"),
            "north_m": (y, "m"),
            "up_m": (height_at(self.terrain, x, y), "m"),
            "east_speed_m_s": (speed[0], "m s-1"),
            "north_speed_m_s": (speed[1], "m s-1"),
            "heading_rad": (heading, "rad"),
            "pitch_rad": (np.arctan(np.sin(heading) * slope[:, 0] + np.cos(heading) * slope[:, 1]), "rad"),
            "length_m": (length, "m"),
            "width_m": (width, "m"),
            "height_m": (height, "m"),
            "class": (np.array(VEHICLE_CLASSES)[self.traffic.model[ids]], "1"),
            "inside": ((x >= west) & (x <= east) & (y >= south) & (y <= north), "1"),
            "moving": (np.hypot(*speed) >= MOVING_SPEED_M_S, "1"),
        }
        variables = {n: ("vehicle", np.asarray(v), {"units": u}) for n, (v, u) in columns.items()}
        truth = xr.Dataset(variables, coords={"vehicle": np.asarray(ids, dtype=np.int64)})
        return schema.check(truth, "truth")

    @property
    def duration_s(self) -> float:
        """Duration of the recorded traffic. [s]"""
        return self.traffic.duration_s

    def _present(self, time_s: float) -> tuple[Int[Array, "vehicle"], Float[Array, "vehicle 5"]]:
        ids, states = self.traffic.at(time_s)
        west, south, east, north = self.extent_m
        near = (states[:, 0] > west - VEHICLE_MARGIN_M) & (states[:, 0] < east + VEHICLE_MARGIN_M)
        near &= (states[:, 1] > south - VEHICLE_MARGIN_M) & (states[:, 1] < north + VEHICLE_MARGIN_M)
        return ids[near], states[near]


def build_scene(design: SceneDesign) -> City:
    """Build a city and its traffic from a design.

    The last city without user files is cached, because the cases of a study share it. Treat it as read-only.

    Parameters
    ----------
    design
        Table ``[scene]`` of a case; the same design gives the same bytes.

    Raises
    ------
    ValueError
        If a file is missing or bad, or an extra or a system library is missing.
    """
    of_files = any(value for key, value in design if key.endswith("_file"))
    city = _build(design) if of_files else _build_cached(design.model_dump_json(exclude_unset=True))
    warn_of_jam(city.traffic, city.extent_m)
    return city


@lru_cache(maxsize=1)
def _build_cached(design: str) -> City:
    return _build(SceneDesign.model_validate_json(design))


def _build(design: SceneDesign) -> City:
    options = design.polarized_bases, design.material_variation
    library, mesh_materials = load_materials(*options), {}
    if design.materials_file:
        path = resolve_file(design.materials_file)
        library, mesh_materials = load_user_materials(path, *options)
    index = material_index(library)
    site = SITES[design.city](design)
    panels = _panels(design, index, site.extent_m)  # a mesh's window is its own
    traffic = site.recording.traffic
    layout_rng, mesh_rng = np.random.default_rng(design.seed).spawn(2)
    terrain, origin_height_m = _terrain(design, site)
    vehicles = build_models(index)
    if site.mesh is not None:
        builder = MeshBuilder(index)
        builder.add_mesh(site.mesh.mesh(mesh_materials, index), np.eye(3, 4), 0)
        for panel in panels:
            layouts.add_panel(builder, panel, terrain)
        static = builder.mesh()
        planted = layouts.Instances(np.zeros((0, 3, 4)), np.zeros(0, np.int64), np.zeros(0, np.int16))
        said = ()
    else:
        layout, said = _plan_layout(site, design.trees, panels, layout_rng)
        keys = _PARKED_PAINT_KEY + np.arange(len(layout.parked))
        parked = choose_paints(library, keys, design.seed)
        ground = None if is_level(terrain) else terrain
        tree_rng, building_rng = mesh_rng.spawn(2)  # so that a city without trees has the same buildings
        static = layouts.build_mesh(layout, site.extent_m, index, building_rng, ground)
        planted = layouts.place_instances(layout, parked, index, len(vehicles), tree_rng, ground)
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
    """Record the streets and traffic of a design without building the city.

    Returns
    -------
    Recording in the coordinates of a ``traffic_file``: those of the network for city ``net`` and ``osm``,
    else ENU. [m]
    """
    site = SITES[design.city](design)
    return site.recording.shift(*site.traffic_origin_m)


def _panels(
    design: SceneDesign, index: dict[str, int], extent_m: tuple[float, float, float, float]
) -> tuple[layouts.Panel, ...]:
    found = []
    for k, panel in enumerate(design.panels):
        if panel.material not in index:
            raise ValueError(
                f"`scene.panels.{k}.material` must be one of the library; got {panel.material!r}. "
                f"{suggest_name(panel.material, index)}"
            )
        half_width, half_length = panel.width_m / 2, panel.length_m / 2
        slab = rotate(box(-half_width, -half_length, half_width, half_length), -panel.heading_deg)
        placed = translate(slab, panel.east_m, panel.north_m)
        if not placed.intersects(box(*extent_m)):
            west, south, east, north = extent_m
            raise ValueError(
                f"`scene.panels.{k}` must lie in the window, east {west:g} to {east:g} m and north {south:g} "
                f"to {north:g} m from its middle; got {panel.east_m:g} and {panel.north_m:g} m."
            )
        found.append(layouts.Panel(panel.material, placed))
    return tuple(found)


def _terrain(design: SceneDesign, site: Site) -> tuple[xr.Dataset, float]:
    """Ground height under the window and its margin, and the height of its zero. [m]"""
    bounds = layouts.expand_extent(site.extent_m, layouts.MARGIN_M)
    if design.dem_file:
        origin = site.place.easting_m, site.place.northing_m
        terrain, origin_height_m = read_dem(resolve_file(design.dem_file), bounds, site.place.crs, origin)
        if site.mesh is None:
            return terrain, origin_height_m
        datum_m = mesh_datum_m(site.mesh, terrain, origin_height_m)
        height = terrain["height"] + (origin_height_m - datum_m)
        return terrain.assign(height=height.assign_attrs(terrain["height"].attrs)), datum_m
    if design.hills_m:
        rng = np.random.default_rng((design.seed, _RELIEF_KEY))
        return rolling_terrain(bounds, design.hills_m, rng), 0.0
    if site.mesh is not None:
        return mesh_terrain(site.mesh, bounds), 0.0
    return flat_terrain(bounds), 0.0


def _plan_layout(
    site: Site, share: float, panels: tuple[layouts.Panel, ...], rng: np.random.Generator
) -> tuple[layouts.Layout, tuple[str, ...]]:
    """Plan the city with a share of its trees, at most `MAX_TREES`, and with nothing on the panels."""
    if site.layout is None:
        raise ValueError("`site` must have a layout or a mesh; got neither.")
    layout = site.layout(rng)
    layout = _thin_out(layout, round(share * len(layout.trees)), rng)
    said: tuple[str, ...] = ()
    if len(layout.trees) > MAX_TREES:
        said = (f"{MAX_TREES} of {len(layout.trees)} trees are used, evenly thinned out",)
        layout = _thin_out(layout, MAX_TREES, rng)
    if panels:
        free = unary_union([p.shape.buffer(1.0) for p in panels])

        def clear(things, distance_m):
            return tuple(t for t in things if free.distance(Point(t.east_m, t.north_m)) > distance_m(t))

        layout = replace(
            layout,
            panels=panels,
            trees=clear(layout.trees, lambda tree: tree.crown_radius_m),
            parked=clear(layout.parked, lambda _: 3.0),
            hedges=clear(layout.hedges, lambda _: 1.5),
        )
    return layout, said


def _thin_out(layout: layouts.Layout, count: int, rng: np.random.Generator) -> layouts.Layout:
    """Select a number of the trees evenly at random."""
    if count >= len(layout.trees):
        return layout
    chosen = np.sort(rng.permutation(len(layout.trees))[:count])
    return replace(layout, trees=tuple(layout.trees[k] for k in chosen))


def glb(snapshot: Snapshot, materials: xr.Dataset) -> bytes:
    """Encode a city at one instant as glTF 2.0 binary, the bytes of a ``.glb`` file.

    Vehicles and plants are instances of their models. Colours are the materials' preview colours, glossy
    where the material has an interface; the format has no spectra and no polarization.

    Parameters
    ----------
    snapshot
        From `City.at`.
    materials
        The city's library.
    """
    document = Document()

    def add_mesh(mesh: Mesh, name: str, paint: int = 0) -> int:
        material = np.where(mesh.material == PAINT, paint, mesh.material)
        return document.add_mesh(mesh.vertices, mesh.faces, material, name)

    rgb = materials["preview_rgb"].values
    rough, gloss, metal = (materials[k].values for k in ("roughness", "specular_weight", "extinction_index"))
    for k, name in enumerate(materials["material"].values):
        roughness = float(np.clip(np.sqrt(rough[k]) if gloss[k] > 0.2 else 1.0, 0.05, 1))
        document.add_material(str(name), rgb[k], 1.0 if metal[k] > 1 else 0.0, roughness)
    document.add_node("ground and buildings", add_mesh(snapshot.static, "static"))
    made: dict[tuple[int, int], int] = {}
    for model, paint, transform, vehicle in zip(
        snapshot.model, snapshot.paint, snapshot.transforms, snapshot.vehicle_id, strict=True
    ):
        key = int(model), int(paint)
        if key not in made:
            made[key] = add_mesh(snapshot.models[key[0]], f"model {key[0]}", key[1])
        name = f"vehicle {int(vehicle)}" if vehicle >= 0 else "planted"
        document.add_node(name, made[key], transform)
    return document.bytes("ENU")
