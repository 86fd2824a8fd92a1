"""Planted signals: only a sensor that has a signal's channel finds or recognizes vehicles by it."""

import numpy as np
import pytest
import xarray as xr

from glintrack.bounds.appearance import Look, find_unseen, recognize_unseen
from glintrack.core.spectral import wavelength_grid
from glintrack.sensor import SensorDesign, build_preset, read_arrays, read_presets

GRID_UM = wavelength_grid(0.4, 1.0)
DESIGN = SensorDesign(rows=96, columns=128, polarizer="ideal")
NAMES = ("pan", "superpixel", "depolarized", "polarimeter", "four-bands", "rgb", "pan-and-bands")
VEHICLES = 16
FALSE_PER_KM2 = 50
KM2 = 6 / FALSE_PER_KM2 / (48 * 64)  # of a superpixel: six false objects in a frame


@pytest.fixture(scope="module")
def sensors():
    found = read_presets()
    assert set(found) == set(NAMES)
    return {name: build_preset(found[name], DESIGN, GRID_UM) for name in NAMES}


def tilted():
    """A spectrum of no band-mean radiance in pan: bluer on the one side, redder on the other."""
    (pan,) = build_preset(read_presets()["pan"], DESIGN, GRID_UM)[0].channels
    return (GRID_UM - pan @ GRID_UM) / 0.3


def places(rng):
    """Vehicles of 4 × 6 elements on a loose grid, whole superpixels each."""
    ids = np.full((DESIGN.rows, DESIGN.columns), -1)
    for k in range(VEHICLES):
        i, j = 8 + 22 * (k // 4) + 2 * rng.integers(4), 10 + 30 * (k % 4) + 2 * rng.integers(4)
        ids[i : i + 4, j : j + 6] = k
    return ids


def frame(ids, rng, polarization, colour, level):
    """Light of a mottled ground; on vehicles, by id, Q/I, the tilt of the spectrum and the level."""
    on = ids >= 0
    ground = 40 * (1 + 0.03 * rng.standard_normal(ids.shape))
    value = {n: np.where(on, np.asarray(v)[ids], 0.0) for n, v in (("q", polarization), ("c", colour))}
    intensity = ground * np.where(on, np.asarray(level)[ids], 1.0)

    def radiance(channels, pixels=None):
        flat, tilt = channels.sum(axis=1), channels @ tilted()
        i = intensity[..., None] * (flat + value["c"][..., None] * tilt)
        light = np.stack([i, value["q"][..., None] * intensity[..., None] * flat, 0 * i], axis=-1)
        return xr.DataArray(light, dims=("y", "x", "channel", "stokes"))

    return radiance


def looks(sensors, city, frames, polarization=0.0, colour=0.0, level=1.0, spread=0.0):
    """Looks of every preset at one city: signals of all vehicles, and their spread between vehicles."""
    rng = np.random.default_rng(city)
    vary = [1 + spread * rng.choice([-1, 1], VEHICLES) * rng.uniform(0.3, 1, VEHICLES) for _ in range(3)]
    signals = polarization * vary[0], colour * vary[1], level * np.ones(VEHICLES)
    out = {name: [] for name in sensors}
    for _ in range(frames):
        ids = places(rng)
        radiance = frame(ids, rng, *signals)
        for name, arrays in sensors.items():
            images = [np.log(np.maximum(one, 1.0)) for one in read_arrays(arrays, radiance, rng)]
            out[name].append(Look(images, ids, np.arange(VEHICLES), np.arange(VEHICLES), KM2))
    return out


def found(sensors, name, **signal):
    cities = [looks({name: sensors[name]}, city, 2, **signal)[name] for city in (1, 2)]
    return find_unseen(cities[:1], cities[1])


@pytest.mark.parametrize(
    ("signal", "able", "blind"),
    [
        ({"polarization": 0.12}, ("polarimeter", "superpixel"), ("pan", "depolarized", "four-bands")),
        ({"colour": 0.3}, ("four-bands", "rgb", "pan-and-bands"), ("pan", "superpixel")),
        ({"level": 1.3}, ("pan", "superpixel"), ()),
    ],
    ids=["polarization", "colour", "level"],
)
def test_a_planted_signal_is_found_by_those_that_have_its_channel(sensors, signal, able, blind):
    shares = {name: found(sensors, name, **signal)["found_50"] for name in (*able, *blind)}
    assert all(shares[name] > 0.95 for name in able), shares
    assert all(shares[name] < 0.3 for name in blind), shares


def test_without_a_signal_vehicles_are_found_by_chance_alone(sensors):
    """Six false peaks of about a hundred in a frame: a vehicle holds less than one peak."""
    none = [found(sensors, name) for name in ("pan", "polarimeter")]
    assert all(one["vehicles"] == 2 * VEHICLES and one["found_50"] < 0.25 for one in none)


def recognized(sensors, name, **signal):
    cities = [looks({name: sensors[name]}, city, 3, spread=1.0, **signal)[name] for city in (1, 2, 3)]
    return recognize_unseen(cities[:2], cities[2])


def test_a_vehicle_is_recognized_by_what_differs_between_vehicles(sensors):
    assert recognized(sensors, "polarimeter", polarization=0.25)["auc"] > 0.9
    assert abs(recognized(sensors, "pan", polarization=0.25)["auc"] - 0.5) < 0.1
    assert recognized(sensors, "four-bands", colour=0.5)["auc"] > 0.9
    assert abs(recognized(sensors, "superpixel", colour=0.5)["auc"] - 0.5) < 0.1
    one = recognized(sensors, "rgb")
    assert abs(one["auc"] - 0.5) < 0.1 and one["vehicles"] == 3 * VEHICLES


def test_cities_without_vehicles_are_refused(sensors):
    (city,) = [looks({"pan": sensors["pan"]}, 1, 2)["pan"]]
    bare = [Look(one.images, np.full_like(one.ids, -1), one.targets, one.excluded, KM2) for one in city]
    for learn, test in (([bare], city), ([city], bare)):
        with pytest.raises(ValueError, match="must have vehicles"):
            find_unseen(learn, test)
        with pytest.raises(ValueError, match="seen in two frames"):
            recognize_unseen(learn, test)
