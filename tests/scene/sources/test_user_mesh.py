"""Meshes made elsewhere: their frame, their materials, their ground, and what is wrong with bad ones."""

import sys

import numpy as np
import pytest
import rasterio

from glintrack.core.installation import MissingExtraError
from glintrack.io.readings import collect_readings
from glintrack.scene import SceneDesign, build_scene
from glintrack.scene.read.mesh import ground_under, read_mesh

trimesh = pytest.importorskip("trimesh")


def street_and_house():
    """A plate 200 m by 100 m at 2 m, x east and z up, and a house on its eastern half."""
    plate = trimesh.creation.box(extents=(200, 100, 2))
    plate.apply_translation((0, 0, 1))
    house = trimesh.creation.box(extents=(20, 10, 8))
    house.apply_translation((60, 20, 6))
    scene = trimesh.Scene()
    scene.add_geometry(plate, geom_name="street")
    scene.add_geometry(house, geom_name="house")
    return scene


def turned_to_y_up(scene):
    turned = scene.copy()
    turned.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return turned


MAP = '[mesh]\nstreet = "asphalt"\nhouse = "lilac"\n\n[lilac]\nconstant = 0.4\nrefractive_index = 1.5\n'
MAP += "roughness = 0.4\nspecular_weight = 0.2\n"


@pytest.fixture
def files(tmp_path):
    turned_to_y_up(street_and_house()).export(tmp_path / "s.glb")
    (tmp_path / "map.toml").write_text(MAP)
    return tmp_path


def design(files, **keys):
    names = {"mesh_file": str(files / "s.glb"), "materials_file": str(files / "map.toml"), **keys}
    return SceneDesign(city="mesh", **names)


def test_gltf_is_turned_to_enu_and_wears_the_librarys_materials(files):
    city = build_scene(design(files))
    assert city.extent_m == pytest.approx((-100, -50, 100, 50))
    names = city.materials["material"].values[city.static.material]
    assert set(names) == {"asphalt", "lilac"}
    house = city.static.vertices[np.unique(city.static.faces[names == "lilac"])]
    np.testing.assert_allclose(house.min(axis=0), [50, 15, 2], atol=1e-4)
    np.testing.assert_allclose(house.max(axis=0), [70, 25, 10], atol=1e-4)
    assert city.truth(0.0).sizes["vehicle"] == 0
    assert any("no traffic" in sentence for sentence in city.assumptions)


def test_panels_lie_in_the_meshs_own_window(files):
    panel = {"material": "panel_50", "north_m": 0.0}
    build_scene(design(files, panels=[{**panel, "east_m": 90.0}]))
    with pytest.raises(ValueError, match=r"`scene.panels.0` must lie in the window, east -100 to 100 m"):
        build_scene(design(files, panels=[{**panel, "east_m": 200.0}]))


def test_vehicles_drive_on_the_meshs_ground(files):
    (files / "f.csv").write_text(
        "timestep_time;vehicle_id;vehicle_type;vehicle_x;vehicle_y;vehicle_angle\n"
        "0;a;car;-30;-20;90\n1;a;car;-20;-20;90\n"
    )
    city = build_scene(design(files, traffic_file=str(files / "f.csv")))
    truth = city.truth(1.0)
    assert float(truth["up_m"][0]) == pytest.approx(2.0, abs=1e-4)
    assert float(truth["east_m"][0]) == pytest.approx(-20 - 2.25)


def test_ground_is_the_lowest_surface_that_faces_up(files):
    mesh = read_mesh(files / "s.glb")
    height = ground_under(mesh, np.array([-20.0, 0, 20, 60]), np.array([20.0, -20]))
    # the house stands on the plate: its roof at 10 m is not the ground under it
    np.testing.assert_allclose(height, 2.0, atol=1e-4)


def test_unit_and_upright_are_the_users_word(files, tmp_path):
    street_and_house().export(tmp_path / "s.ply")
    metres = read_mesh(tmp_path / "s.ply")
    assert metres.extent_m == pytest.approx((-100, -50, 100, 50))
    assert read_mesh(tmp_path / "s.ply", unit_m=0.5).extent_m == pytest.approx((-50, -25, 50, 25))
    assert read_mesh(tmp_path / "s.ply", up="y").extent_m == pytest.approx((-100, -10, 100, 0))


def test_a_mesh_that_seems_to_lie_on_its_side_is_refused(files, tmp_path):
    """As Blender writes an OBJ by default: y up."""
    turned_to_y_up(street_and_house()).export(tmp_path / "s.ply")
    with pytest.raises(ValueError, match=r"seems to have its y axis up, 200 × 10 × 100 along x, y, z"):
        read_mesh(tmp_path / "s.ply")
    assert read_mesh(tmp_path / "s.ply", up="y").extent_m == pytest.approx((-100, -50, 100, 50))
    assert read_mesh(tmp_path / "s.ply", up="z").extent_m == pytest.approx((-100, 0, 100, 10))


def test_what_is_taken_of_axes_unit_and_ground_is_told(files):
    taken = {"up is the mesh's y axis (scene.mesh_up)", "the mesh is in metres (scene.mesh_unit_m)"}
    assert taken < set(build_scene(design(files)).assumptions)
    said = build_scene(design(files, mesh_up="y", mesh_unit_m=1.0)).assumptions
    assert not [one for one in said if "scene.mesh_" in one]


def export(tmp_path, vertices, faces, name="m.ply"):
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / name)
    return tmp_path / name


SQUARE = np.array([[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0]], float)
FACES = [[0, 1, 2], [0, 2, 3]]


def test_bad_meshes_get_one_sentence(tmp_path):
    with pytest.raises(
        ValueError, match=r"20 to 20000 m wide .*got 1e\+05 m .*perhaps 0.001 for millimetres"
    ):
        read_mesh(export(tmp_path, SQUARE * 1000, FACES))
    with pytest.raises(ValueError, match=r"20 to 20000 m wide .*got 0.1 m .*perhaps 1000 for kilometres"):
        read_mesh(export(tmp_path, SQUARE / 1000, FACES))
    with pytest.raises(ValueError, match="must have finite coordinates; got 3 of 4"):
        read_mesh(export(tmp_path, np.where(np.eye(4, 3) > 0, np.nan, SQUARE), FACES[:1]))
    with pytest.raises(ValueError, match="must lie about its origin; got coordinates up to"):
        read_mesh(export(tmp_path, SQUARE + [600_000, 5_000_000, 0], FACES))
    with pytest.raises(ValueError, match="must have triangles with an area"):
        read_mesh(export(tmp_path, SQUARE, [[0, 1, 1]]))
    with pytest.raises(ValueError, match=r"`mesh_file` must end in .glb"):
        read_mesh(tmp_path / "m.fbx")
    (tmp_path / "broken.glb").write_bytes(b"glTF" + bytes(40))
    with pytest.raises(ValueError, match=r"`mesh_file` must be a whole mesh; got 'broken.glb'") as error:
        read_mesh(tmp_path / "broken.glb")
    assert "\n" not in str(error.value)


def test_edges_that_are_open_or_of_three_faces_are_told_not_refused(tmp_path):
    fin = np.vstack([SQUARE, [50, 50, 40]])
    with collect_readings() as readings:
        read_mesh(export(tmp_path, fin, [*FACES, [0, 2, 4]]))
    assert any("1 edges join more than two triangles" in note for note in readings[-1].notes)
    assert any("edges are open" in note for note in readings[-1].notes)


def test_triangles_that_lie_on_others_are_left_out_and_told(tmp_path):
    twice = [*FACES, [2, 1, 0]]  # the first once more, seen from behind
    with collect_readings() as readings:
        mesh = read_mesh(export(tmp_path, SQUARE, twice))
    np.testing.assert_array_equal(mesh.faces, FACES)
    assert readings[-1].left_out == (("on others: the first is used", 1),)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "got none for 'house'.*Its names: 'house', 'street'"),
        ('[mesh]\n"*" = "mud"\n', "got 'mud' for 'house'"),
        ("[mesh]\nstreet = 3\n", r"must give names under \[mesh\]"),
        ('[mesh]\nstreat = "asphalt"\n"*" = "asphalt"\n', "got 'streat'. Did you mean `street`"),
    ],
)
def test_a_mesh_without_materials_is_refused(files, text, sentence):
    (files / "map.toml").write_text(text)
    with pytest.raises(ValueError, match=sentence):
        build_scene(design(files))


def test_without_the_extra_it_is_named(files, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(MissingExtraError, match=r"extra `mesh`.*pip install .*\[mesh\]"):
        build_scene(design(files))


def test_a_window_may_be_smaller_than_the_mesh_and_must_be_on_a_large_one(files):
    city = build_scene(design(files, width_m=80, height_m=60))
    assert city.extent_m == (-40, -30, 40, 30)
    with pytest.raises(ValueError, match=r"must cover at most 4 km²; got 4000 m × 2000 m.*Give width_m"):
        build_scene(design(files, mesh_unit_m=20))


def test_what_the_library_logs_of_a_file_is_not_shown(tmp_path, caplog):
    """A text STL with a normal that is none: trimesh logs a traceback, and reads the triangle."""
    path = tmp_path / "a.stl"
    corners = "".join(f"vertex {x} {y} 0\n" for x, y in ((0, 0), (99, 0), (0, 99)))
    path.write_text(f"solid a\nfacet normal 0 0 one\nouter loop\n{corners}endloop\nendfacet\nendsolid a\n")
    assert len(read_mesh(path).faces) == 1
    assert caplog.records == []


def with_elevations(files, dem_m, lifted_m):
    """Keys of a scene with a level elevation model, and the mesh lifted; a parked car on the street."""
    scene = street_and_house()
    scene.apply_translation((0, 0, lifted_m))
    turned_to_y_up(scene).export(files / "s.glb")
    steps = "".join(
        f'<timestep time="{t}"><vehicle id="a" x="-20" y="0" angle="90" type="car"/></timestep>'
        for t in range(3)
    )
    (files / "f.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    with rasterio.open(
        files / "d.tif", "w", driver="GTiff", width=200, height=200, count=1, dtype="float32",
        crs="EPSG:32632", transform=rasterio.Affine(10, 0, 499_000, 0, -10, 5_501_000),
    ) as file:  # fmt: skip
        file.write(np.full((200, 200), dem_m, np.float32), 1)
    keys = {"traffic_file": str(files / "f.xml"), "dem_file": str(files / "d.tif")}
    return keys | {"crs": "EPSG:32632", "origin_m": (500_000.0, 5_500_000.0)}


@pytest.mark.parametrize("lifted_m", [-2.0, 48.0])
def test_vehicles_stand_on_a_mesh_beside_an_elevation_model(files, lifted_m):
    """The mesh's heights are relative to the ground at its origin, or those of the model, 50 m there."""
    city = build_scene(design(files, **with_elevations(files, 50.0, lifted_m)))
    assert city.truth(1.0)["up_m"].values == pytest.approx(2 + lifted_m, abs=0.01)
    assert city.origin_height_m + 2 + lifted_m == pytest.approx(50)


def test_a_mesh_at_other_heights_than_its_elevation_model_is_refused(files):
    with pytest.raises(ValueError, match=r"its ground at the heights.*got -58\.0 m and \+42\.0 m"):
        build_scene(design(files, **with_elevations(files, 100.0, 40.0)))
