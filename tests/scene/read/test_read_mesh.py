"""Meshes are read whole: polygons of any shape, names, strips, and what is refused by its name."""

import base64
import json
import struct

import numpy as np
import pytest
from shapely.geometry import Polygon

from glintrack.io.readings import collect_readings
from glintrack.scene.read.mesh import read_mesh
from glintrack.scene.read.polygon_mesh import triangulate

trimesh = pytest.importorskip("trimesh")

L_SHAPE = ((100, -100), (100, 0), (0, 0), (0, 100), (-100, 100), (-100, -100))
DART = ((0, 0), (100, -50), (20, 0), (100, 50))  # a concave quadrangle


def areas(mesh):
    """Area of each name, and the mean upward share of its normals."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a) / 2
    found = {}
    for k, name in enumerate(mesh.names):
        mine = normal[mesh.name_of == k]
        found[name] = float(np.linalg.norm(mine, axis=1).sum())
        assert (mine[:, 2] > 0).all() or not (mine[:, 2] > 0).any()
    return found


def star(seed):
    """A star-shaped polygon, mostly concave, in a tilted plane."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 12))
    plan = rng.uniform(10, 60, 12)[:, None] * np.c_[np.cos(angle), np.sin(angle)]
    return plan, np.c_[plan, 0.4 * plan[:, 0] - 0.7 * plan[:, 1]]


@pytest.mark.parametrize("seed", range(8))
def test_concave_polygons_have_their_area_and_face_their_way(seed):
    plan, corners = star(seed)
    faces = triangulate(corners, [list(range(12)), list(range(11, -1, -1))])
    a, b, c = (corners[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a) / 2
    assert normal[:10, 2].sum() == pytest.approx(Polygon(plan).area)
    assert normal[10:, 2].sum() == pytest.approx(-Polygon(plan).area)
    assert (normal[:10, 2] > 0).all() and (normal[10:, 2] < 0).all()


def test_quadrangles_that_are_concave_are_not_cut_across():
    corners = np.array([(*point, 0.0) for point in DART])
    for start in range(4):
        faces = triangulate(corners, [[(start + k) % 4 for k in range(4)]])
        a, b, c = (corners[faces[:, k]] for k in range(3))
        assert np.abs(np.cross(b - a, c - a)[:, 2]).sum() / 2 == pytest.approx(Polygon(DART).area)


def test_obj_polygons_relative_indices_and_names_without_a_library(tmp_path):
    text = "mtllib gone.mtl\no ground\n# a comment\n"
    text += "".join(f"v {x} {y} 0\n" for x, y in L_SHAPE)
    text += "usemtl dark lawn\nf -6 -5 -4 \\\n-3 -2 -1\no roof\n"
    text += "v 10 10 25\nv 30 10 25\nv 30 30 25\nv 10 30 25\nusemtl roof\nf -4/1/2 -3//2 -2 -1\nl 1 2\n"
    (tmp_path / "a.obj").write_text(text)
    with collect_readings() as readings:
        mesh = read_mesh(tmp_path / "a.obj")
    assert areas(mesh) == pytest.approx({"dark lawn": 30_000, "roof": 400})
    assert (readings[0].content, readings[0].found, readings[0].used) == ("faces", 3, 2)
    assert readings[0].left_out == (("lines and points", 1),)
    (tmp_path / "b.obj").write_text(text.replace("usemtl dark lawn\n", "").replace("usemtl roof\n", ""))
    assert areas(read_mesh(tmp_path / "b.obj")) == pytest.approx({"ground": 30_000, "roof": 400})


@pytest.mark.parametrize(
    ("line", "sentence"),
    [("f 1 2 99", "a corner that is none of 6"), ("f 0 1 2", "none of 6"), ("surf 0 1 0 1 1 2", r"\(surf\)")],
)
def test_obj_faces_of_other_points_and_free_forms_are_refused(tmp_path, line, sentence):
    (tmp_path / "a.obj").write_text("".join(f"v {x} {y} 0\n" for x, y in L_SHAPE) + f"f 1 2 3\n{line}\n")
    with pytest.raises(ValueError, match=sentence):
        read_mesh(tmp_path / "a.obj")


PLY_HEAD = (
    "ply\nformat {} 1.0\ncomment c\nelement vertex 10\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 3\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
)
PLY_POINTS = [*((x, y, 0) for x, y in L_SHAPE), (200, 0, 0), (300, 0, 0), (300, 100, 0), (200, 100, 0)]
PLY_FACES = ((0, 1, 2, 3, 4, 5), (6, 7, 8), (6, 8, 9))


def ply(kind):
    head = PLY_HEAD.format(kind).encode()
    if kind == "ascii":
        rows = [" ".join(map(str, p)) for p in PLY_POINTS]
        rows += [" ".join(map(str, (len(f), *f, 7))) for f in PLY_FACES]
        return head + "\n".join(rows).encode()
    order = "<" if "little" in kind else ">"
    body = b"".join(struct.pack(f"{order}3f", *p) for p in PLY_POINTS)
    return head + body + b"".join(struct.pack(f"{order}B{len(f)}iB", len(f), *f, 7) for f in PLY_FACES)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_faces_of_different_lengths(tmp_path, kind):
    (tmp_path / "a.ply").write_bytes(ply(kind))
    assert sum(areas(read_mesh(tmp_path / "a.ply")).values()) == pytest.approx(40_000)
    (tmp_path / "a.ply").write_bytes(ply(kind)[:-9])
    with pytest.raises(ValueError, match="must be a whole mesh"):
        read_mesh(tmp_path / "a.ply")


def test_ply_and_stl_of_another_library_are_the_same(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=40.0)
    for name in ("a.ply", "a.stl"):
        sphere.export(tmp_path / name)
        mesh = read_mesh(tmp_path / name)
        assert len(mesh.faces) == len(sphere.faces)
        np.testing.assert_allclose(mesh.vertices[mesh.faces], sphere.triangles, atol=1e-4)
    content = (tmp_path / "a.stl").read_bytes()
    (tmp_path / "b.stl").write_bytes(b"solid a\n" + content[:200])
    with pytest.raises(ValueError, match="mesh_file"):
        read_mesh(tmp_path / "b.stl")


GROUND = np.array([[-150, 0, -100], [150, 0, -100], [150, 0, 100], [-150, 0, 100]], np.float32)
STRIP = np.array([0, 3, 1, 2], np.uint16)
FAN = np.array([0, 3, 2, 1], np.uint16)
TRIANGLES = np.array([0, 2, 1, 0, 3, 2], np.uint16)


def gltf(path, indices, primitive=None, node=None, **more):
    """A file with one ground of one primitive."""
    blob = GROUND.tobytes() + indices.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    about = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}
    about |= {"min": GROUND.min(0).tolist(), "max": GROUND.max(0).tolist()}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | (node or {})],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1} | (primitive or {})]}],
        "accessors": [
            about,
            {"bufferView": 1, "componentType": 5123, "count": len(indices), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": GROUND.nbytes},
            {"buffer": 0, "byteOffset": GROUND.nbytes, "byteLength": indices.nbytes},
        ],
        "buffers": [{"byteLength": len(blob), "uri": uri}],
    }
    path.write_text(json.dumps(tree | more))
    return path


@pytest.mark.parametrize(("indices", "mode"), [(TRIANGLES, 4), (STRIP, 5)])
def test_gltf_primitives_are_counted(tmp_path, indices, mode):
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [0, 9, 0]}, {"mesh": 0}]
    path = gltf(
        tmp_path / "a.gltf", indices, {"mode": mode}, nodes=nodes, scenes=[{"nodes": [0, 1]}, {"nodes": [2]}]
    )
    with collect_readings() as readings:
        mesh = read_mesh(path)
    assert sum(areas(mesh).values()) == pytest.approx(2 * 60_000)
    assert (readings[0].content, readings[0].found, readings[0].used) == ("primitives", 3, 2)
    assert readings[0].left_out == (("not in the scene", 1),)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"extensionsRequired": ["EXT_mesh_gpu_instancing"]}, "the extension EXT_mesh_gpu_instancing"),
        ({"extensionsUsed": ["EXT_mesh_gpu_instancing"]}, "the extension EXT_mesh_gpu_instancing"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"primitive": {"mode": 6}, "indices": FAN}, "TRIANGLE_FAN"),
        ({"node": {"skin": 0}}, "a skin"),
        ({"node": {"weights": [0.0, 0.5]}}, "morph targets"),
    ],
)
def test_features_that_would_be_lost_are_refused_by_name(tmp_path, keys, sentence):
    with pytest.raises(ValueError, match=sentence):
        read_mesh(gltf(tmp_path / "a.gltf", **{"indices": TRIANGLES} | keys))


def test_extensions_of_appearance_are_no_reason_to_refuse(tmp_path):
    path = gltf(
        tmp_path / "a.gltf", TRIANGLES, extensionsRequired=["KHR_materials_unlit", "KHR_texture_transform"]
    )
    assert sum(areas(read_mesh(path)).values()) == pytest.approx(60_000)
