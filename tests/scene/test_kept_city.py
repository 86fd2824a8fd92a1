"""A city that was built before is read: the same to the last bit, and never another design's."""

import numpy as np
import pytest

from glintrack.scene import build_scene, city
from tests.scene.read.test_read_sumo_net import NET
from tests.scene.sources.test_user_network import FCD, tiny

RING = "20,10 40,10 40,30 20,30 20,10"


@pytest.fixture
def files(tmp_path):
    (tmp_path / "n.net.xml").write_text(NET)
    (tmp_path / "f.xml").write_text(FCD)
    write_house(tmp_path, 21)
    return tmp_path


@pytest.fixture
def built(monkeypatch, tmp_path):
    """The plans that were built, not read, with a cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    plans, build = [], city.build_mesh

    def building(layout, *rest):
        plans.append(layout)
        return build(layout, *rest)

    monkeypatch.setattr(city, "build_mesh", building)
    return plans


def write_house(folder, height_m):
    poly = f'<poly id="a" type="building" height="{height_m}" shape="{RING}"/>'
    (folder / "p.xml").write_text(f"<additional>{poly}</additional>")


def design(files, **keys):
    return tiny(files, polygons_file=str(files / "p.xml"), **keys)


def test_the_second_time_it_is_read_and_the_same(files, built):
    first, second = build_scene(design(files)), build_scene(design(files))
    assert len(built) == 1
    assert first.assumptions == second.assumptions != ()
    for one, other in ((first.static, second.static), (first.planted, second.planted)):
        for name, array in vars(one).items():
            again = getattr(other, name)
            assert again.dtype == array.dtype and np.array_equal(again, array), name
    assert len(second.planted) and len(second.static.faces)


@pytest.mark.parametrize(
    "keys", [{"seed": 2}, {"trees": 0.5}, {"centre_m": (52.0, 0.0)}, {"fill_blocks": True}]
)
def test_another_design_is_built(files, built, keys):
    build_scene(design(files))
    build_scene(design(files).model_copy(update=keys))
    assert len(built) == 2


def test_when_and_what_drives_builds_nothing(files, built):
    build_scene(design(files))
    build_scene(design(files, traffic_start_s=0.5))
    assert len(built) == 1


def test_a_changed_file_is_built(files, built):
    low = build_scene(design(files))
    write_house(files, 30)
    high = build_scene(design(files))
    assert len(built) == 2
    assert high.static.vertices[:, 2].max() > low.static.vertices[:, 2].max()


def test_a_damaged_file_is_built_anew(files, built, tmp_path):
    build_scene(design(files))
    (kept,) = (tmp_path / "cache" / "glintrack" / "cities").iterdir()
    kept.write_bytes(kept.read_bytes()[:-7])
    build_scene(design(files))
    assert len(built) == 2


def test_without_a_place_to_keep_it_is_built(files, built, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/none")
    with pytest.warns(UserWarning, match="cannot be written"):
        build_scene(design(files))
    assert len(built) == 1
