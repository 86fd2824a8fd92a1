"""What cases of a set share does not change what each of them holds."""

from types import SimpleNamespace

import pytest

from glintrack import Case
from glintrack.case import build as scenario
from glintrack.dataset import build_dataset, plan_dataset, together
from glintrack.dataset.plan import Shard
from glintrack.dataset.together import SceneFlights, by_scene
from glintrack.render import Observer
from glintrack.scene import load_materials
from tests.conftest import ThreeCars


def case(name, **changes):
    design = {
        "name": name,
        "seed": 4,
        "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 2, "rate_hz": 2.0},
        "sensor": {"rows": 64, "columns": 80},
        "navigation": {"position_rms_m": 0.2},
    }
    return Case.model_validate({**design, **changes})


CASES = [
    case("a"),
    case("b", seed=5),  # other noise and reported poses over the same hits
    case("c", flight={"off_nadir_deg": 20.0, "altitude_m": 2819.1, "frames": 2, "rate_hz": 2.0}),
    case("d", scene={"seed": 9}),
]


def files_of(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_shard_holds_the_same_bytes_alone_and_beside_others(monkeypatch, tmp_path):
    """Three scenes are asked for and two built; of eight frames six are traced."""
    built, traced = [], []
    observe = Observer.observe

    def counted(self, *arguments):
        traced.append(arguments)
        return observe(self, *arguments)

    def city(design):
        built.append(design)
        return ThreeCars(load_materials())

    monkeypatch.setattr(scenario, "build_scene", city)
    monkeypatch.setattr(Observer, "observe", counted)
    plan = plan_dataset(CASES)
    assert build_dataset(plan, tmp_path / "beside") == 8
    assert len(built) == 2 and len(traced) == 6
    beside = files_of(tmp_path / "beside")
    for one in CASES[:3]:
        build_dataset(plan_dataset([one]), tmp_path / one.name)
        alone = files_of(tmp_path / one.name)
        mine = [name for name in alone if name.startswith(("raw", "shards", "cases"))]
        assert len(mine) == 7
        assert all(alone[name] == beside[name] for name in mine)


def test_shards_that_see_the_same_are_flown_together():
    shards = [Shard(one, 0, range(2)) for one in CASES] + [Shard(CASES[0], 1, range(2, 4))]
    order = [[[s.case.name for s in group] for group in scene] for scene in by_scene(shards)]
    assert order == [[["a", "b"], ["c"], ["a"]], [["d"]]]


def test_jitter_is_the_seeds_and_light_is_nobodys():
    shaky, lower = {**CASES[0].flight.model_dump(), "jitter_rms_urad": 20.0}, {"sun_zenith_deg": 40.0}

    def groups(*cases):
        return len(by_scene(Shard(one, 0, range(2)) for one in cases)[0])

    assert groups(case("a"), case("b", seed=5, atmosphere={"aerosol": "urban"})) == 1
    assert groups(case("a", flight=shaky), case("b", seed=5, flight=shaky)) == 2
    assert groups(case("a"), case("b", atmosphere={**lower, "sun_azimuth_deg": 200.0})) == 2


@pytest.mark.parametrize(("most", "of_second", "fresh"), [(9, [3, 4], 1), (3, [1, 2], 2)])
def test_a_shard_that_coarsens_the_probes_of_others_is_flown_anew(monkeypatch, most, of_second, fresh):
    """Probes that others asked for must not decide how finely a shard's own light is found."""
    made, told = [], []

    def build(one, like=None):
        if like is not None:
            return like
        made.append(SimpleNamespace(asked=0, coarsened=False))
        return SimpleNamespace(observer=SimpleNamespace(tracer=SimpleNamespace(probes=made[-1])))

    def frames(one, scenario, which, cache):
        probes = scenario.observer.tracer.probes
        for _ in which:
            probes.asked += 1
            probes.coarsened = probes.asked > most
            yield probes.asked

    monkeypatch.setattr(together, "build_scenario", build)
    monkeypatch.setattr(together, "labelled_frames", frames)
    flights = SceneFlights()
    assert flights.fly([Shard(CASES[0], 0, range(2))], told.append) == [[1, 2]]
    assert flights.fly([Shard(CASES[1], 0, range(2))], told.append) == [of_second]
    assert len(made) == fresh and [shard.case.name for shard in told] == ["a", "a", "b", "b"]
