"""Probes on disk: the same to the last bit, for the same scene, sun and question alone."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.render import build_tracer, kept_probes, solid_heights, trace
from glintrack.render.kept_probes import KeptProbes, ProbesByKey, scene_content
from glintrack.render.probes import SceneProbes
from glintrack.scene import Mesh
from tests.conftest import box, nadir, plane, small_camera, snapshot

SUN = np.array([0.6, 0.0, 0.8])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kept_probes, "WORTH_KEEPING", 10)
    return tmp_path / "glintrack" / "probes"


def scene(height=20.0):
    """A house on a plane."""
    ground, house = plane(), box(20, 20, height)
    return snapshot(
        Mesh(
            np.concatenate([ground.vertices, house.vertices]),
            np.concatenate([ground.faces, house.faces + len(ground.vertices)]),
            np.concatenate([ground.material, house.material]),
        )
    )


def table_of(still, sun=SUN, side=60, keep=True, ahead=False):
    tracer = build_tracer(still, keep_probes=keep)
    if ahead:
        tracer.probes.toward(sun.astype(np.float32), 0).read_ahead()
    trace(still, small_camera(side, side, 90), nadir(), sun, np.ones(3), tracer=tracer)
    return tracer.probes.table


def test_a_second_flight_reads_what_the_first_gathered(folder, monkeypatch):
    first = table_of(scene())
    files = list(folder.iterdir())
    assert files and len(first.view) >= 10

    def refuse(*_):
        raise AssertionError("rays of probes were followed again")

    monkeypatch.setattr("glintrack.render.probes.SceneProbes._gather", refuse)
    second = table_of(scene())
    for before, after in zip(first, second, strict=True):
        assert before.dtype == after.dtype and np.array_equal(before, after)
    assert list(folder.iterdir()) == files


def test_what_is_read_ahead_is_read_once(folder, monkeypatch):
    first, read = table_of(scene()), []
    by_key = KeptProbes.by_key

    def count(*arguments):
        read.append(1)
        return by_key(*arguments)

    monkeypatch.setattr(KeptProbes, "by_key", count)
    second = table_of(scene(), ahead=True)
    assert len(read) == 1
    assert all(np.array_equal(before, after) for before, after in zip(first, second, strict=True))


def test_another_view_reads_what_one_gathered(folder, monkeypatch):
    """A probe is the same to the last bit whoever asked for it, and among whichever others."""
    table_of(scene(), side=40)
    wide = table_of(scene(), side=80, keep=False)
    asked = []
    gather = SceneProbes._gather

    def count(self, wanted, *rest):
        asked.append(len(wanted))
        gather(self, wanted, *rest)

    monkeypatch.setattr(SceneProbes, "_gather", count)
    after = table_of(scene(), side=80)
    assert 0 < sum(asked) < 0.1 * len(wide.view)
    for alone, both in zip(wide, after, strict=True):
        assert np.array_equal(alone, both)


def test_what_was_taken_is_let_go_and_the_rest_stays_whole():
    """Probes of one row and of six, in two lots that share some: each is found where it was, once."""
    keys, rows = np.arange(60) * 7, np.where(np.arange(60) % 5 == 0, 6, 1).astype(np.int8)
    values = np.repeat(keys, rows) + 0.01 * np.arange(rows.sum())
    ends = np.cumsum(rows, dtype=int)

    def lot(first, last):
        own = values[ends[first] - rows[first] : ends[last - 1]]
        return np.array([last - first]), keys[first:last], rows[first:last], own

    held = ProbesByKey([lot(0, 40), lot(37, 60)], lambda _: None)
    sizes = []
    for asked in np.split(np.random.default_rng(3).permutation(60), 6):
        first = np.cumsum(rows[asked], dtype=int) - rows[asked]
        out = np.zeros(rows[asked].sum())
        assert held.take(keys[asked], first, rows[asked], (out,)).all()
        wanted = [values[ends[k] - rows[k] : ends[k]] for k in asked]
        np.testing.assert_array_equal(out, np.concatenate(wanted))
        sizes.append(sum(part.nbytes for part in held._known))
    assert sizes[2] < 0.6 * sizes[0] and sizes[-1] < 0.2 * sizes[0]
    assert not held.take(keys[:1] + 1, np.zeros(1, int), np.ones(1, int), (np.zeros(1),)).any()


def test_another_scene_or_sun_is_gathered_anew(folder):
    low = table_of(scene())
    high = table_of(scene(60.0))
    assert high.view.mean() < low.view.mean()
    before = len(list(folder.iterdir()))
    table_of(scene(), np.array([0.0, 0.6, 0.8]))
    assert len(list(folder.iterdir())) > before


def test_a_scene_is_told_from_another_by_all_that_stands():
    one = scene_content(scene(), None, None, None)
    assert one == scene_content(scene(), None, None, None)
    others = [
        scene_content(scene(21.0), None, None, None),
        scene_content(scene(), np.array([0.0, 0.5]), None, None),
        scene_content(scene(), None, np.ones((2, 1)), None),
        scene_content(scene(), None, None, (0.0, 0.0, 1.0, 1.0)),
    ]
    assert len({one, *others}) == 5


def test_arrays_of_any_length_come_back_as_they_were_made(tmp_path, monkeypatch):
    """Those of parked vehicles: tables whose lengths only who fills them knows."""
    monkeypatch.setattr(kept_probes, "_WORTH_KEEPING_BYTES", 10)
    kept, like = KeptProbes("scene", tmp_path), (np.zeros((0, 4), np.int32), np.zeros(0, np.float32))
    made = np.arange(48, dtype=np.int32).reshape(12, 4), np.linspace(0, 1, 5, dtype=np.float32)

    def refuse():
        raise AssertionError("made again")

    assert kept.whole(like, (np.ones(2),), lambda: made) is made
    again = kept.whole(like, (np.ones(2),), refuse)
    for before, after in zip(made, again, strict=True):
        assert before.dtype == after.dtype and np.array_equal(before, after) and after.flags.writeable
    with pytest.raises(AssertionError, match="made again"):
        kept.whole(like, (np.zeros(2),), refuse)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(AssertionError, match="made again"):  # a damaged file
        kept.whole(like, (np.ones(2),), refuse)


def test_parked_vehicles_are_probed_once_for_all_flights(folder, monkeypatch):
    monkeypatch.setattr(kept_probes, "_WORTH_KEEPING_BYTES", 10)
    beside_the_house = np.tile(np.eye(3, 4), (4, 1, 1))
    beside_the_house[:, :2, 3] = [[15.0, 3.0 * k] for k in range(4)]
    cars = snapshot(scene().static, (box(4.0, 2.0, 1.5),), beside_the_house, np.zeros(4, int))
    parked = replace(cars, fixed=4)
    first = table_of(parked)

    def refuse(*_):
        raise AssertionError("rays of vehicles were followed again")

    monkeypatch.setattr("glintrack.render.probes.probe_bodies", refuse)
    second = table_of(parked)
    assert all(np.array_equal(before, after) for before, after in zip(first, second, strict=True))


def test_the_map_of_heights_is_kept_with_the_probes(tmp_path, monkeypatch):
    """A second map of the same scene draws and sweeps nothing, and is the same to the last bit."""
    window, leaves = (-30.0, -30.0, 30.0, 30.0), np.zeros(2, np.bool_)
    kept = KeptProbes(scene_content(scene(), None, None, window), tmp_path)
    first = solid_heights.solid_heights(scene(), leaves, window, kept)

    def refuse(*_):
        raise AssertionError("the map was made again")

    monkeypatch.setattr(solid_heights, "_draw_all", refuse)
    monkeypatch.setattr(solid_heights, "_add_sky_view", refuse)
    second = solid_heights.solid_heights(scene(), leaves, window, kept)
    assert len(np.unique(first.cells[..., 0])) == 2 and np.array_equal(first.cells, second.cells)
    assert (first.middle_m, first.step_m, first.cell_m) == (10.0, second.step_m, second.cell_m)
    with pytest.raises(AssertionError, match="made again"):
        solid_heights.solid_heights(scene(), leaves, (-30.0, -30.0, 40.0, 30.0), kept)
