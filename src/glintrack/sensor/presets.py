"""Sensors to compare behind one lens: a preset divides the same light between arrays of filtered elements."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import Radiance
from glintrack.core.spectral import band_response
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.exposure import light_on_elements, read_out
from glintrack.sensor.layouts import OPEN
from glintrack.sensor.lens_kernels import lens_kernels
from glintrack.sensor.polarizer import load_polarizer
from glintrack.sensor.response import element_response, photon_gain, photon_weights
from glintrack.sensor.sensor import Sensor, build_sensor

_FILE = resources.files("glintrack") / "data" / "presets.toml"
_NOTHING = 1e-9  # of the bare response: rounding in an analyser row


class PresetArray(NamedTuple):
    """Share of the light that falls on an array, and the filters over its elements.

    Parameters
    ----------
    light
        Share of the light, 0 to 1. [1]
    elements
        Filter of each element of the superpixel: ``"open"``, a name of the filters, or the angle of a
        polarizer. [deg]
    """

    light: float
    elements: tuple[tuple[str | float, ...], ...]


@dataclass(frozen=True)
class Preset:
    """Sensor of one or more arrays that see the same field.

    Parameters
    ----------
    name, description
        Of the sensor.
    arrays
        Arrays behind the beam splitters.
    filters_um
        First and last wavelength of each filter. [µm]
    depolarizer
        Whether the light has S1 = S2 = 0.
    """

    name: str
    description: str
    arrays: tuple[PresetArray, ...]
    filters_um: Mapping[str, tuple[float, float]]
    depolarizer: bool = False


@lru_cache(maxsize=1)
def read_presets() -> dict[str, Preset]:
    """Packaged presets by name."""
    tables = tomllib.loads(_FILE.read_text(encoding="utf-8"))
    filters = {name: (float(band[0]), float(band[1])) for name, band in tables["filters_um"].items()}
    found = {}
    for name, table in tables["presets"].items():
        arrays = tuple(PresetArray(a["light"], tuple(map(tuple, a["elements"]))) for a in table["arrays"])
        found[name] = Preset(
            name, table["description"], arrays, filters, bool(table.get("depolarizer", False))
        )
    return found


def element_curves(
    kind: str | float,
    filters_um: Mapping[str, tuple[float, float]],
    design: SensorDesign,
    wavelength_um: Float[Array, "wavelength"],
) -> Float[Array, "3 wavelength"]:
    """Response of an element to I, Q and U of the light on it. [electrons per photon]

    Parameters
    ----------
    kind, filters_um
        As in `PresetArray` and `Preset`.
    design, wavelength_um
        Band, quantum efficiency, lens and polarizer; and the grid. [µm]
    """
    bare = element_response(design, wavelength_um)
    out = np.zeros((3, len(bare)))
    if not isinstance(kind, str):
        used = bare > 0
        row = load_polarizer(design).analyser_row(wavelength_um[used], math.radians(kind))
        out[:, used] = row[:, :3].T * bare[used]
    else:
        out[0] = bare if kind == OPEN else bare * band_response(*filters_um[kind], wavelength_um)
    return out


def build_preset(
    preset: Preset, design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> tuple[Sensor, ...]:
    """Sensor of each array of a preset, with lens, pitch, exposure and electronics of a design.

    Parameters
    ----------
    preset
        From `read_presets`.
    design
        The sensor whose superpixel the preset replaces.
    wavelength_um
        Grid of the radiance. [µm]

    Raises
    ------
    ValueError
        If the design's band has no light for one of the filters.
    """
    return tuple(_build_array(array, preset, design, wavelength_um) for array in preset.arrays)


def _build_array(array: PresetArray, preset: Preset, design: SensorDesign, wavelength_um: Array) -> Sensor:
    side = len(array.elements)
    own = design.replace(
        {
            "layout": ((OPEN,) * side,) * side,
            "demosaic": "superpixel",
            "fill_dark_mirrors": "none",
            "optics.depolarizer": preset.depolarizer,
        }
    )
    base = build_sensor(own, wavelength_um)
    found = []  # element, component of the light, channel, electrons
    for i, j in np.ndindex(side, side):
        kind = array.elements[i][j]
        curves = element_curves(kind, preset.filters_um, own, wavelength_um)
        if not curves[0].any():
            raise ValueError(
                f"`sensor.band_um` must contain the filter {kind!r} of the preset {preset.name!r}; "
                f"got {own.band_um[0]:g} to {own.band_um[1]:g} µm."
            )
        for component, curve in enumerate(curves):
            if np.abs(curve).max() > _NOTHING * curves[0].max():
                weights = photon_weights(wavelength_um, curve)
                sign = math.copysign(array.light, weights.sum())
                gain = sign * photon_gain(own, wavelength_um, np.abs(curve))
                found.append(((i, j), component, math.copysign(1.0, sign) * weights, gain))
    channels, index = unique_channels([one[2] for one in found])
    planes = tuple(sorted({(k, one[1]) for k, one in zip(index.tolist(), found, strict=True)}))
    gains, white = np.zeros((side, side, len(planes))), np.zeros((side, side, 3))
    for k, (place, component, weights, gain) in zip(index.tolist(), found, strict=True):
        gains[(*place, planes.index((k, component)))] += gain
        white[(*place, component)] += gain * weights.sum()
    kernels = lens_kernels(base.design, wavelength_um, np.abs(channels))
    return replace(
        base, channels=channels, planes=planes, element_gains=gains, stokes_gains=white, kernels=kernels
    )


def unique_channels(channels: Sequence[Array]) -> tuple[Float[Array, "channel wavelength"], Array]:
    """Distinct channels, and the index of each one's own."""
    rows, index = np.unique(np.round(np.array(channels), 12), axis=0, return_inverse=True)
    return rows, index.ravel()


def read_arrays(
    arrays: Sequence[Sensor], radiance: Radiance, rng: np.random.Generator
) -> list[Float[Array, "row column"]]:
    """Readings of some arrays of the same light, each with its own noise. [W m⁻² sr⁻¹ µm⁻¹]

    Parameters
    ----------
    arrays
        From `build_preset`, of one or more presets.
    radiance
        Light of the frame; it is shaded once for all arrays.
    rng
        Source of the noise.
    """
    weights, index = unique_channels(np.concatenate([sensor.channels for sensor in arrays]))
    light, start, out = np.asarray(radiance(weights).values), 0, []
    for sensor in arrays:
        mine = index[start : start + len(sensor.channels)]
        start += len(mine)
        out.append(read_out(light_on_elements(light[:, :, mine], sensor), sensor, rng))
    return out
