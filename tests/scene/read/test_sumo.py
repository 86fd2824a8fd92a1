"""SUMO: what is said when it is missing, and the cache that keeps its runs."""

import importlib.util
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glintrack.core.installation import MissingExtraError
from glintrack.scene.objects.surfaces import Lane, RoadNetwork
from glintrack.scene.read import sumo
from glintrack.scene.read.sumo import SumoRun, load_or_simulate, vehicle_types_xml
from glintrack.scene.traffic import Recording, Traffic


@pytest.fixture
def run(tmp_path):
    path = tmp_path / "x.nod.xml"
    path.write_text("<nodes/>")
    return SumoRun((path,), ("-n", "x.nod.xml"), (0, 0, 1, 1), (0, 0), 10, 5, 1.0, 42)


@pytest.fixture
def simulated(monkeypatch, tmp_path):
    """Stands in for SUMO; counts its runs."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    calls = []

    def simulate(run):
        calls.append(run)
        lane = Lane("e", 0, "car", np.array([[0, 0], [1, 1.00049]]), 3.2)
        one = np.zeros(2)
        traffic = Traffic(0.1, 2, np.array([0]), np.array([2]), np.array([0]), one, one, one)
        return Recording(RoadNetwork((lane,), (np.eye(3, 2),)), traffic)

    monkeypatch.setattr(sumo, "simulate_traffic", simulate)
    return calls


def cached_files(tmp_path):
    return [p for p in (tmp_path / "cache" / "glintrack" / "traffic").iterdir()]


def test_second_call_comes_from_the_cache(run, simulated, tmp_path):
    first, second = load_or_simulate(run), load_or_simulate(run)
    assert len(simulated) == 1 and len(cached_files(tmp_path)) == 1
    assert first.network.lanes[0].points.tobytes() == second.network.lanes[0].points.tobytes()
    assert first.traffic.bumper_east.tobytes() == second.traffic.bumper_east.tobytes()


def test_other_settings_or_inputs_are_another_run(run, simulated):
    load_or_simulate(run)
    load_or_simulate(SumoRun(**{**vars(run), "duration_s": 6}))
    run.inputs[0].write_text("<nodes></nodes>")
    load_or_simulate(run)
    assert len(simulated) == 3


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:-1] + b"x"])
def test_damaged_cache_is_rebuilt(run, simulated, tmp_path, damage):
    load_or_simulate(run)
    (path,) = cached_files(tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    assert load_or_simulate(run).traffic.steps == 2
    assert len(simulated) == 2 and len(cached_files(tmp_path)) == 1


def test_unwritable_cache_costs_only_the_cache(run, simulated, tmp_path):
    (tmp_path / "cache").write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match="cannot be written"):
        assert load_or_simulate(run).traffic.steps == 2


def test_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="`traffic` must be installed to run SUMO"):
        sumo.sumo_home()


def test_missing_system_library_names_the_debian_packages(monkeypatch, tmp_path):
    text = "sumo: error while loading shared libraries: libX11.so.6: cannot open shared object file"
    done = subprocess.CompletedProcess([], 127, "", text)
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: done)
    with pytest.raises(
        MissingExtraError, match=r"libX11.so.6.*libx11-6 libxext6 libxrender1 libgl1 libexpat1"
    ):
        sumo.call_sumo(tmp_path, tmp_path, [str(tmp_path / "bin" / "sumo")])


def test_failure_of_sumo_is_one_sentence(monkeypatch, tmp_path):
    done = subprocess.CompletedProcess([], 1, "Loading\n", "Error: no edges\nQuitting (on error).\n")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: done)
    with pytest.raises(
        ValueError, match="`netconvert` of SUMO must succeed; got exit 1: Error: no edges"
    ) as caught:
        sumo.call_sumo(tmp_path, tmp_path, [str(Path("bin") / "netconvert")])
    assert "\n" not in str(caught.value)


def test_vehicle_types_hold_the_models_dimensions():
    text = vehicle_types_xml()
    assert 'id="car" vClass="passenger" length="4.5" width="1.8" height="1.5"' in text
    assert text.count("<vType id") == 5


@pytest.mark.parametrize(("seed", "given"), [(42, 42), (2**31 - 1, 2**31 - 1), (2**31 + 7, 7), (2**63, 0)])
def test_sumo_gets_a_seed_of_31_bits(seed, given, run, monkeypatch, tmp_path):
    words = []

    def call(home, folder, command):
        words.extend(command)
        if Path(command[0]).name == "sumo":
            raise KeyboardInterrupt

    monkeypatch.setattr(sumo, "sumo_home", lambda: tmp_path)
    monkeypatch.setattr(sumo, "call_sumo", call)
    with pytest.raises(KeyboardInterrupt):
        sumo.simulate_traffic(replace(run, seed=seed))
    seeds = [int(words[k + 1]) for k, word in enumerate(words) if word == "--seed"]
    assert seeds == [given, given]  # of the trips, and of the drivers
