"""Variation of a material over the ground and between vehicles: its statistics, and what it must conserve."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import Pose, look_at
from glintrack.render import shade, trace, unpack_sky
from glintrack.render.shading.materials import unpack_surfaces
from glintrack.scene import load_materials
from glintrack.scene.materials import material_index
from glintrack.stokes import dolp
from tests.conftest import box, flat_sky, nadir, plane, small_camera, snapshot

SKY = unpack_sky(flat_sky(40, 180, sun=1000.0, sky_radiance=60.0), 1000.0)


def light(library, scene, pose, camera):
    """Stokes vectors of each element in each band, (element, band, 3)."""
    hits = trace(scene, camera, pose, SKY.sun_direction, library["roughness"].values)
    bands = len(SKY.wavelength_um)
    return shade(hits, SKY, library, np.eye(bands)).values.reshape(-1, bands, 3)


@pytest.fixture(scope="module", params=["asphalt", "grass", "concrete"])
def ground(request):
    """Light of a plane of one material, without variation and with that of the library."""
    camera, pose = small_camera(80, 80, 600.0), look_at(Pose(0.0, 700.0, 800.0), [0.0, 0.0, 0.0])
    libraries = [load_materials(variation=factor) for factor in (0.0, 1.0)]
    scene = snapshot(plane(4000.0, material=material_index(libraries[0])[request.param]))
    return [light(library, scene, pose, camera) for library in libraries]


def test_mean_over_the_ground_stays(ground):
    even, varied = ground
    np.testing.assert_allclose(varied[..., 0].mean(axis=0), even[..., 0].mean(axis=0), rtol=0.03)


def test_colour_and_degree_of_polarization_vary(ground):
    """By 1 to 15 % of the ratio of two bands, and by a tenth to a third of DoLP."""
    even, varied = ground
    ratio = varied[:, 0, 0] / varied[:, -1, 0] / (even[:, 0, 0] / even[:, -1, 0])
    assert 0.01 < ratio.std() < 0.15
    degree = dolp(varied[:, 0]) / dolp(even[:, 0])
    assert 0.1 < degree.std() < 0.33


def test_light_is_possible(ground):
    for values in ground:
        assert (values[..., 0] >= 0).all()
        assert (np.hypot(values[..., 1], values[..., 2]) <= values[..., 0]).all()


def test_least_share_leaves_a_base_between_black_and_white():
    library = load_materials(variation=1.0)
    tables = unpack_surfaces(library, SKY.wavelength_um)
    varied, rho = tables.toward >= 0, library["reflectance"].values
    assert varied.sum() > 30
    share = tables.variation[varied, 3:]
    base = (1 - share) * rho[varied] + share * rho[tables.toward[varied]]
    assert base.min() > -1e-6 and base.max() < 1 + 1e-6
    assert (load_materials()["gloss_variation"] == 0).all()


def test_vehicles_of_one_paint_differ():
    library = load_materials(variation=1.0)
    paint = material_index(library)["paint_grey"]
    place = [[[1, 0, 0, 12.0 * k - 60], [0, 1, 0, 0], [0, 0, 1, 0]] for k in range(10)]
    scene = snapshot(
        plane(400.0), [box(5.0, 5.0, 1.5, material=paint)], place, np.zeros(10, int), np.arange(10)
    )
    camera = small_camera(41, 201, 200.0)
    hits = trace(scene, camera, nadir(), SKY.sun_direction, library["roughness"].values)
    values = light(library, scene, nadir(), camera)[:, 3, 0]
    element = hits.element
    roofs = (hits.material == paint) & (hits.normal[:, 2] > 0.9) & (hits.weight > 0.99)
    by_vehicle = [values[element[roofs & (hits.vehicle_id == k)]] for k in range(10)]
    assert max(roof.std() / roof.mean() for roof in by_vehicle) < 0.01  # one vehicle is even
    level = np.array([roof.mean() for roof in by_vehicle])
    assert 0.02 < level.std() / level.mean() < 0.25


@pytest.mark.parametrize("parked", [True, False])
def test_each_vehicle_has_its_own_paint_also_a_parked_one(parked):
    """Over a roof of 8 m by 4 m the paint is one; from vehicle to vehicle it is not."""
    libraries = [load_materials(variation=factor) for factor in (0.0, 1.0)]
    index = material_index(libraries[0])
    ids = [-1] * 6 if parked else range(6)
    places = [[[1, 0, 0, 15.0 * k - 37.5], [0, 1, 0, 0], [0, 0, 1, 0]] for k in range(6)]
    car = box(8.0, 4.0, 1.5, material=index["paint_white"])
    scene = snapshot(plane(400.0, material=index["asphalt"]), [car], places, [0] * 6, vehicle_id=list(ids))
    scene = replace(scene, fixed=6 * parked)
    camera, pose = small_camera(40, 360, 90.0), nadir(800.0)
    hits = trace(scene, camera, pose, SKY.sun_direction, libraries[0]["roughness"].values)
    assert len(np.unique(hits.vehicle_id)) == 7
    alone = np.add.reduceat(np.ones(len(hits.material), int), hits.first[:-1]) == 1
    alone &= hits.normal[hits.first[:-1], 2] > 0.99  # the roofs
    vehicle = np.where(alone, hits.vehicle_id[hits.first[:-1]], -1)
    even, varied = (light(one, scene, pose, camera)[:, 0, 0] for one in libraries)
    factors = [(varied / even)[vehicle == k] for k in np.unique(vehicle) if k != -1]
    assert len(factors) == 6 and min(map(len, factors)) > 20
    assert max(one.std() for one in factors) < 1e-3
    assert np.std([one.mean() for one in factors]) > 0.01


def test_what_the_interface_reflects_more_polarizes_the_base_more():
    """White paint in a white furnace: all light is unpolarized and as bright as around, at any gloss."""
    library = load_materials(variation=1.0)
    index = material_index(library)
    for name in ("reflectance", "colour_variation", "vehicle_variation"):
        values = library[name].values
        values[index["paint_white"]] = 1.0 if name == "reflectance" else 0.0
    places = [[[1, 0, 0, 15.0 * k - 37.5], [0, 1, 0, 0], [0, 0, 1, 0]] for k in range(6)]
    car = box(8.0, 4.0, 0.01, material=index["paint_white"])
    scene = snapshot(plane(400.0, material=index["asphalt"]), [car], places, [0] * 6)
    camera, pose = small_camera(40, 360, 90.0), look_at(Pose(0.0, -1500.0, 800.0), [0.0, 0.0, 0.0])
    hits = trace(scene, camera, pose, SKY.sun_direction, library["roughness"].values)
    hits.sun_visible[:] = 0
    bands = len(SKY.wavelength_um)
    found = shade(hits, SKY, library, np.eye(bands)).values.reshape(-1, bands, 3)
    seen = hits.vehicle_id[hits.first[:-1]] >= 0
    assert seen.sum() > 100
    assert np.abs(found[seen, 0, 1:] / found[seen, 0, :1]).max() < 0.004
