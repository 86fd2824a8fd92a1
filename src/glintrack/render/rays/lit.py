"""A scene at one time under its sun: what rays meet, and how much sunlight arrives there."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from glintrack.atmosphere.design import SUN_RADIUS_RAD
from glintrack.core.arrays import Array
from glintrack.render.rays.resolve import Surfaces, resolve
from glintrack.render.rays.tracer import SceneTracer
from glintrack.render.rays.tracer_protocol import Past
from glintrack.scene import Snapshot

_FEW = 0.5  # of surfaces that the sun may light: those alone are gathered into packets


@dataclass(frozen=True)
class Lit:
    """A scene at one time under its sun, with its instances placed; rays go past all of it or a part."""

    tracer: SceneTracer
    snapshot: Snapshot
    surroundings: int
    sun: Array
    past: Past = "all"

    def meet(self, origins: Array, starts: Array, directions: Array, coherent: bool = False) -> Surfaces:
        """Surfaces that rays meet; ``starts`` are their origins in single precision."""
        met = self.tracer.rays.intersect(starts, directions, coherent, self.past)
        known = self.tracer.faces, self.snapshot, self.surroundings, self.sun, self.tracer.sheets
        return resolve(origins, directions, met, *known)

    def sunlight(self, seen: Surfaces, samples: int = 1, coherent: bool = False) -> Float[Array, "ray"]:
        """Part of the sun's light that arrives at each surface, by rays to points of its disc."""
        wanted = seen.sun_cosine != 0
        light = np.zeros(len(wanted), np.float32)
        some, start = slice(None), seen.lifted
        # packets that are full of rays are traced faster
        if not coherent and np.count_nonzero(wanted) < _FEW * len(wanted):
            some = np.flatnonzero(wanted)
            wanted, start = wanted[some], start[some]
        for direction in _sun_disc(self.sun.tobytes(), self.sun.dtype.str, samples):
            light[some] += self.tracer.rays.transmitted(start, direction[None], wanted, coherent, self.past)
        return light / np.float32(samples)


@lru_cache(maxsize=8)  # asked for by every lot of rays
def _sun_disc(toward: bytes, kind: str, samples: int) -> Float[Array, "sample 3"]:
    """Directions toward points spread evenly over the sun's disc; its centre if there is one. [1]"""
    sun = np.frombuffer(toward, kind)
    k = np.arange(samples)
    across = 0.0 if samples == 1 else np.tan(SUN_RADIUS_RAD) * np.sqrt((k + 0.5) / samples)
    turn = math.pi * (3 - math.sqrt(5)) * k  # the golden angle: a sunflower's seeds
    level = np.array([-sun[1], sun[0], 0.0]) if abs(sun[2]) < 0.9 else np.array([0.0, -sun[2], sun[1]])
    level /= np.linalg.norm(level)
    offset = (across * np.cos(turn))[:, None] * level + (across * np.sin(turn))[:, None] * np.cross(
        sun, level
    )
    directions = sun + offset
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
