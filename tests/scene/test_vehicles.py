"""Every vehicle is a closed body at its vType's size, with glass at its true rake."""

import math
from collections import Counter

import numpy as np
import pytest

from glintrack.scene.materials import load_materials, material_index
from glintrack.scene.vehicles import VEHICLE_CLASSES, build_model, load_vehicles

INDEX = material_index(load_materials())
NAMES = list(VEHICLE_CLASSES)


def built(name):
    return build_model(load_vehicles()[name], INDEX)


def face_normals(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(float) for i in range(3))
    return 0.5 * np.cross(b - a, c - a), (a + b + c) / 3


@pytest.mark.parametrize("name", NAMES)
def test_every_edge_belongs_to_two_faces_that_run_it_in_opposite_ways(name):
    mesh = built(name)
    edges = Counter((int(f[i]), int(f[(i + 1) % 3])) for f in mesh.faces for i in range(3))
    assert max(edges.values()) == 1
    assert all((b, a) in edges for a, b in edges)


@pytest.mark.parametrize("name", NAMES)
def test_every_closed_part_faces_outward(name):
    mesh = built(name)
    label = np.arange(len(mesh.vertices))
    for _ in range(len(label)):  # vertices joined by faces get the least of their labels
        least = label[mesh.faces].min(axis=1)
        after = label.copy()
        for i in range(3):
            np.minimum.at(after, mesh.faces[:, i], least)
        if (after == label).all():
            break
        label = after
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(float) for i in range(3))
    six_volumes = np.sum(a * np.cross(b, c), axis=1)
    for part in np.unique(label):
        assert six_volumes[label[mesh.faces[:, 0]] == part].sum() > 0


@pytest.mark.parametrize("name", NAMES)
def test_size_is_that_of_the_vtype_about_the_centre_of_the_footprint(name):
    design, vertices = load_vehicles()[name], built(name).vertices
    half_millimetre = 5e-4
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose(
        high, [design.length_m / 2, design.width_m / 2, design.height_m], atol=half_millimetre
    )
    np.testing.assert_allclose(low, [-design.length_m / 2, -design.width_m / 2, 0], atol=half_millimetre)


@pytest.mark.parametrize(
    ("name", "least_deg", "most_deg"),
    [
        ("car", 27, 33),
        ("hatch", 27, 33),
        ("suv", 32, 37),
        ("van", 39, 47),
        ("bus", 75, 85),
        ("truck", 75, 85),
    ],
)
def test_windscreen_rake_above_the_horizontal(name, least_deg, most_deg):
    mesh = built(name)
    normal, centre = face_normals(mesh)
    front = (
        (mesh.material == INDEX["glass"])
        & (normal[:, 0] > 0)
        & (np.abs(centre[:, 1]) < 0.25 * load_vehicles()[name].width_m)
    )
    front &= np.abs(normal[:, 1]) < 0.5 * np.linalg.norm(normal, axis=1)
    middle = normal[front].sum(axis=0)
    rake = math.degrees(math.acos(middle[2] / np.linalg.norm(middle)))
    assert least_deg < rake < most_deg


@pytest.mark.parametrize("name", ["car", "hatch", "van"])
def test_painted_roof_is_crowned(name):
    mesh = built(name)
    normal, centre = face_normals(mesh)
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    roof = (mesh.material == -1) & (unit[:, 2] > 0.9) & (centre[:, 2] > 0.9 * load_vehicles()[name].height_m)
    tilts = np.degrees(np.arccos(np.clip(unit[roof, 2], -1, 1)))
    assert np.unique(np.round(tilts, 1)).size >= 3


@pytest.mark.parametrize("name", NAMES)
def test_has_paint_glass_and_tyres_on_the_ground(name):
    mesh = built(name)
    assert {-1, INDEX["glass"], INDEX["tyre_rubber"]} <= set(mesh.material.tolist())
    tyres = mesh.vertices[np.unique(mesh.faces[mesh.material == INDEX["tyre_rubber"]])]
    assert tyres[:, 2].min() == 0
    assert len(mesh.faces) < 700


@pytest.mark.parametrize("name", NAMES)
def test_tyres_are_round(name):
    mesh, design = built(name), load_vehicles()[name]
    tyres = mesh.vertices[np.unique(mesh.faces[mesh.material == INDEX["tyre_rubber"]])].astype(float)
    axle = np.array([design.length_m / 2 - a for a in design.axles_m])
    nearest = axle[np.abs(tyres[:, :1] - axle).argmin(axis=1)]
    radius = np.hypot(tyres[:, 0] - nearest, tyres[:, 2] - design.tyre_m / 2)
    tread = radius[radius > 0.8 * design.tyre_m / 2]
    np.testing.assert_allclose(tread, design.tyre_m / 2, atol=1e-6)
    assert tread.size == 24 * len(axle) * (1 if design.single_track else 2)
