"""Embree's shared library is found where each platform's wheel holds it, and packets of any width agree."""

import numpy as np
import pytest

from glintrack.render.rays.bvh import BvhTracer
from glintrack.render.rays.embree import WIDTHS, EmbreeTracer, _library_file
from tests.conftest import box, plane


@pytest.mark.parametrize(
    "held",
    [
        "embreex.libs/libembree4-5d1b6f2c.so.4",
        "embreex.libs/embree4.dll",
        "embreex/.dylibs/libembree4.4.dylib",
    ],
)
def test_the_library_of_each_wheel_is_found(tmp_path, held):
    """Files as the wheels of embreex 4.4.0.post1 for Linux, Windows and macOS name them."""
    package = tmp_path / "embreex"
    package.mkdir()
    library = tmp_path / held
    library.parent.mkdir(exist_ok=True)
    for name in (library, library.with_name("tbb12.dll"), library.with_name("libtbb.12.11.dylib")):
        name.touch()
    assert _library_file(package) == library


def test_a_wheel_without_embree_is_told(tmp_path):
    (tmp_path / "embreex").mkdir()
    with pytest.raises(ValueError, match=r"`embreex` must carry libembree4 or embree4.dll; got none beside"):
        _library_file(tmp_path / "embreex")


@pytest.mark.parametrize("lanes", WIDTHS)
def test_packets_of_any_width_meet_what_the_tree_in_numba_meets(lanes):
    """1001 rays, which fill no packet evenly, at boxes that stand and boxes that move."""
    pytest.importorskip("embreex")
    rng = np.random.default_rng(1)
    ground, models = plane(), (box(2, 3, 4), box(4, 2, 1))
    gaps = (np.zeros(len(ground.faces)), np.full(len(models[0].faces), 0.4), np.zeros(len(models[1].faces)))
    gaps = tuple(gap.astype(np.float32) for gap in gaps)
    places = np.tile(np.eye(3, 4), (9, 1, 1))
    places[:, :2, 3] = rng.uniform(-8, 8, (9, 2))
    kind = np.arange(9) % 2
    origins = rng.uniform([-10, -10, 3], [10, 10, 20], (1001, 3)).astype(np.float32)
    below = (rng.uniform(-8, 8, (1001, 3)) * [1, 1, 0] + [0, 0, 0.01]).astype(np.float32)
    along = below - origins
    along = (along / np.linalg.norm(along, axis=1, keepdims=True)).astype(np.float32)
    wanted = rng.random(1001) < 0.8
    found = []
    for tracer in (EmbreeTracer, BvhTracer):
        rays = tracer(ground, models, places[:5], kind[:5], gaps=gaps)
        if isinstance(rays, EmbreeTracer):
            assert rays.lanes in WIDTHS
            rays.lanes = lanes
        rays.update(places[5:], kind[5:])
        found.append((*rays.intersect(origins, along), rays.transmittance(below, -along, wanted)))
    theirs, ours = found
    same = (theirs[1] == ours[1]) & (theirs[2] == ours[2])
    assert same.mean() > 0.99 and len(np.unique(ours[2])) == 10  # the ground and nine boxes
    assert np.abs(theirs[0] - ours[0])[same].max() < 1e-4
    assert (np.abs(theirs[4] - ours[4]) < 1e-5).mean() > 0.99
    assert (theirs[4][~wanted] == 0).all() and len(np.unique(np.round(ours[4], 3))) > 2
