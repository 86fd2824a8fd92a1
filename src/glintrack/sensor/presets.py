"""Sensors to compare behind one lens: a preset divides the same light between arrays of filtered elements."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.installation import read_data
from glintrack.core.records import Radiance
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.exposure import light_on_elements, read_out
from glintrack.sensor.layouts import OPEN, Superpixel, superpixel
from glintrack.sensor.lens_kernels import lens_kernels
from glintrack.sensor.polarizer import load_polarizer
from glintrack.sensor.response import element_response, filtered_response, photon_gain, photon_weights
from glintrack.sensor.sensor import Sensor, build_sensor

_NOTHING = 1e-9  # electrons per photon: rounding in an analyser row


def read_presets() -> dict[str, dict[str, Any]]:
    """Read the packaged presets, by name; `data/presets.toml` describes their keys."""
    return read_data("presets.toml")


def element_curves(
    element: str | float, design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "3 wavelength"]:
    """Response of an element to I, Q and U of the light on it. [electrons per photon]"""
    bare, out = element_response(design, wavelength_um), np.zeros((3, len(wavelength_um)))
    if isinstance(element, str):
        out[0] = filtered_response(design, element, wavelength_um)
        return out
    used = bare > 0
    row = load_polarizer(design).analyser_row(wavelength_um[used], math.radians(element))
    out[:, used] = row[:, :3].T * bare[used]
    return out


def build_preset(
    preset: Mapping[str, Any], design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> tuple[Sensor, ...]:
    """Sensor of each array of a preset, with lens, pitch, exposure and electronics of a design."""
    own = {"optics.depolarizer": preset.get("depolarizer", False), "fill_dark_mirrors": "none"}
    return tuple(_build_array(design.replace(own), wavelength_um, **one) for one in preset["arrays"])


def _build_array(
    design: SensorDesign, wavelength_um: Array, light: float, elements: str | Superpixel
) -> Sensor:
    kinds = superpixel(elements, "elements")
    side = len(kinds)
    design = design.replace({"layout": ((OPEN,) * side,) * side, "demosaic": "superpixel"})
    curves = np.array([[element_curves(what, design, wavelength_um) for what in row] for row in kinds])
    used = np.argwhere(np.abs(curves).max(axis=-1) > _NOTHING)  # row, column, component
    weights = np.array([photon_weights(wavelength_um, curves[tuple(one)]) for one in used])
    signs = np.sign(weights.sum(axis=1))
    channels, index = _unique_channels(signs[:, None] * weights)
    planes = tuple(sorted(set(zip(index.tolist(), used[:, 2].tolist(), strict=True))))
    gains, white = np.zeros((side, side, len(planes))), np.zeros((side, side, 3))
    for k, (i, j, component), sign, weight in zip(index.tolist(), used.tolist(), signs, weights, strict=True):
        gain = light * photon_gain(design, wavelength_um, np.abs(curves[i, j, component]))
        gains[i, j, planes.index((k, component))] = sign * gain
        white[i, j, component] = gain * weight.sum()
    base = build_sensor(design, wavelength_um)
    own = {"channels": channels, "planes": planes, "element_gains": gains, "stokes_gains": white}
    return replace(base, **own, kernels=lens_kernels(base.design, wavelength_um, np.abs(channels)))


def _unique_channels(channels: Array) -> tuple[Array, Array]:
    """Distinct channels, and the index of each one's own."""
    rows, index = np.unique(np.round(channels, 12), axis=0, return_inverse=True)
    return rows, index.ravel()


def read_arrays(
    arrays: Sequence[Sensor], radiance: Radiance, rng: np.random.Generator
) -> list[Float[Array, "row column"]]:
    """Read out arrays of `build_preset` in the same light, shaded once. [W m⁻² sr⁻¹ µm⁻¹]"""
    weights, index = _unique_channels(np.concatenate([sensor.channels for sensor in arrays]))
    parts = np.split(index, np.cumsum([len(sensor.channels) for sensor in arrays])[:-1])
    light = np.asarray(radiance(weights).values)
    planes = [light_on_elements(light[:, :, part], one) for part, one in zip(parts, arrays, strict=True)]
    return [read_out(some, sensor, rng) for some, sensor in zip(planes, arrays, strict=True)]
