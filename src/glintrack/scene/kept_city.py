"""What stands in a city on disk: the next flight over the same streets reads it, and does not build it.

Files are addressed by all that the buildings depend on: the design but for its traffic, its files of streets
and houses, streets, terrain and materials as they were read, and the program. What is read is to the last
bit what would have been built.
"""

import io
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from glintrack.io import cache
from glintrack.io.atomic import content_hash
from glintrack.scene.design import SceneDesign
from glintrack.scene.objects.geometry import Mesh
from glintrack.scene.objects.layout import Instances
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.read.sumo import sumo_version
from glintrack.scene.sources.user_network import resolve_file

MOST_BYTES = 300_000_000  # of all files: some sixty cities of the default size
_SUFFIX = ".city"
_FILES = "net_file", "osm_file", "polygons_file"  # terrain and materials count as they were read
_ARRAYS = ("vertices", "faces", "material", "transforms", "model", "paint")


class Standing(NamedTuple):
    """What stands in a city: its mesh, what is placed in it, and what was guessed in its plan."""

    static: Mesh
    planted: Instances
    assumptions: tuple[str, ...]


def kept_or_built(content: str, build: Callable[[], Standing]) -> Standing:
    """What was kept of a city; else what ``build`` makes, which is kept.

    Parameters
    ----------
    content
        All that it depends on: `standing_content`.
    build
        Builds it.
    """
    stem, folder = cache.content_stem(content), cache.cache_folder("cities")
    data = cache.read(stem, _SUFFIX, folder)
    if data is not None:
        return _unpacked(data)
    found = build()
    if cache.keep(stem, _SUFFIX, folder, _packed(found)) is not None:
        cache.trim(_SUFFIX, folder, MOST_BYTES)
    return found


def standing_content(
    design: SceneDesign, streets: RoadNetwork, terrain: xr.Dataset, materials: xr.Dataset
) -> str:
    """Hash of all that buildings, trees and ground depend on."""
    own = {name: value for name, value in design.model_dump().items() if not name.startswith("traffic_")}
    files = [resolve_file(own[name]).read_bytes() for name in _FILES if own[name]]
    lanes = [(lane.edge_id, lane.index, lane.kind, lane.width_m, lane.signalled) for lane in streets.lanes]
    kinds = [lane.street_type for lane in streets.lanes]
    words = own, lanes, kinds, sumo_version(), materials["material"].values.tolist()
    arrays = [*(lane.points for lane in streets.lanes), *streets.junctions, materials["paint_share"].values]
    arrays += [terrain[name].values for name in sorted(map(str, terrain.variables))]
    shapes = [f"{one.dtype.str}{one.shape}" for one in arrays]
    values = [np.ascontiguousarray(one).tobytes() for one in arrays]
    return content_hash([_programs(), repr(words), *shapes, *files, *values])


def _packed(found: Standing) -> bytes:
    mesh, planted = found.static, found.planted
    arrays = (mesh.vertices, mesh.faces, mesh.material, planted.transforms, planted.model, planted.paint)
    file = io.BytesIO()
    np.savez(
        file, assumptions=np.array(found.assumptions, np.str_), **dict(zip(_ARRAYS, arrays, strict=True))
    )
    return file.getvalue()


def _unpacked(data: bytes) -> Standing:
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = [file[name] for name in _ARRAYS]
        said = tuple(map(str, file["assumptions"]))
    return Standing(Mesh(*arrays[:3]), Instances(*arrays[3:]), said)


@lru_cache(maxsize=1)
def _programs() -> str:
    """Hash of this package's source, and the versions of the libraries that cut shapes."""
    own = Path(__file__).parent
    sources = [own.parent / "core/heights.py", *sorted(own.rglob("*.py"))]
    cut = [version(name) for name in ("shapely", "mapbox_earcut", "numpy")]
    return content_hash([*cut, *(source.read_bytes() for source in sources)])
