"""Searches that cost nothing: scores are known functions of pitch, frame rate and city."""

import math
import zlib
from pathlib import Path

import numpy as np

from glintrack.metrics.requirement import read_requirement
from glintrack.study.optimize import Problem

SPEC = """
case = "base.toml"
require = ["custody >= 0.6", "false_per_km2 <= 20"]
simulations = 60
candidates = 64
durations_s = [6, 12]
[axes]
sensor.pitch_um = { from = 8, to = 17 }
flight.rate_hz = { from = 1, to = 4 }
"""
BASE = 'channels = ["pan"]\nsensor.rows = 280\nsensor.columns = 440\n'


def write_spec(folder, text=SPEC):
    """A file beside its base case."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "base.toml").write_text(BASE)
    path = folder / "spec.toml"
    path.write_text(text)
    return path


def true_scores(pitch_um, rate_hz):
    """Custody and false tracks per km², means over all cities."""
    fine = (17 - pitch_um) / 9
    custody = 0.35 + 0.4 * (1 - math.exp(-2 * fine)) + 0.1 * (rate_hz - 1)
    return custody, 26 - 8 * fine - 2 * (rate_hz - 1)


def camera(case, task):
    """Scores of a case, with an effect of its city and noise; each simulated case leaves a file."""
    seconds = case.flight.frames / case.flight.rate_hz
    custody, false = true_scores(case.sensor.pitch_um, case.flight.rate_hz)
    of_city = np.random.default_rng(case.scene.seed).normal(0, 1, 2)
    design = (case.sensor.pitch_um, case.flight.rate_hz, case.scene.seed, case.flight.frames)
    noise = np.random.default_rng(zlib.crc32(repr(design).encode())).normal(0, 1, 2)
    scores = {
        "custody": custody + 0.04 * of_city[0] + 0.1 / math.sqrt(seconds) * noise[0],
        "false_per_km2": false * math.exp(0.1 * of_city[1] + 0.3 / math.sqrt(seconds) * noise[1]),
        "completeness": custody,
        "purity": 0.9,
        "frames": float(case.flight.frames),
        "data_rate_mbit_s": 1.0,
    }
    if task.cache:
        Path(task.cache, f"simulated-{task.case_key}").touch()
    return {"scores": {"pan": scores}, "files": {}}


class Grid:
    """Stored grid of designs with an effect of each city and noise, for searches without simulations.

    Parameters
    ----------
    places, cost
        Designs.
    means
        True score of each design and requirement.
    limits
        Texts of the requirements.
    city_sd, noise_sd
        Of each requirement: absolute for shares, relative for rates.
    """

    def __init__(self, places, cost, means, limits, city_sd, noise_sd, seed=0):
        self.places, self.cost, self.means = places, cost, means
        self.requirements = tuple(read_requirement(text) for text in limits)
        self.city_sd, self.noise_sd, self.seed, self.count = np.array(city_sd), np.array(noise_sd), seed, 0

    def problem(self, **more):
        return Problem(self.places, self.cost, self.requirements, **more)

    def simulate(self, designs, cities, fidelity):
        """Scores; those of half the duration have √2 times the noise."""
        self.count += len(designs) * len(cities)
        of_city = np.array([np.random.default_rng((self.seed, c)).normal(0, self.city_sd) for c in cities])
        noise = np.array(
            [
                [np.random.default_rng((self.seed, d, c, fidelity)).normal(0, self.noise_sd) for c in cities]
                for d in designs
            ]
        )
        change = of_city[None] + noise * 2 ** (fidelity / 2)
        means = self.means[list(designs)][:, None]
        shares = np.array([one.limit <= 1 for one in self.requirements])
        variance = self.city_sd**2 + self.noise_sd**2 * 2**fidelity  # so that a rate's mean is the true one
        return np.where(shares, means + change, means * np.exp(change - 0.5 * variance))

    @property
    def feasible(self):
        """Whether each design meets all requirements in the mean over all cities."""
        limits = np.array([one.limit for one in self.requirements])
        rising = np.array([one.at_least for one in self.requirements])
        return np.where(rising, self.means >= limits, self.means <= limits).all(axis=1)
