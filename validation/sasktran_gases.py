"""Error of the tables' gases: sky and path compared with exponential sums with absorption solved in.

    python validation/sasktran_gases.py [--bands 0.69 0.76 0.94]

The tables solve sky and path without gases and multiply them by what the gases leave. Here every gas that
takes 2 % out of the sun's path is a sum of up to 8 exponentials of its amount, each product of terms is
solved with its own absorption, and the sum of their light is the band's. Rows of its
output are in docs/theory/atmosphere.md.
"""

import argparse
import math
from dataclasses import dataclass, replace

import numpy as np

from glintrack.atmosphere import AtmosphereDesign
from glintrack.atmosphere.assemble import assemble_tables, build_medium
from glintrack.atmosphere.design import GROUND_ALBEDO
from glintrack.atmosphere.gas import gas_amounts, gas_terms, slant_weights
from glintrack.atmosphere.solve import Directions, Medium, solve_fields
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
from glintrack.atmosphere.tables import with_radiances
from glintrack.core.arrays import Array

BANDS_UM = (0.55, 0.60, 0.69, 0.72, 0.76, 0.82, 0.86, 0.94, 1.13, 1.6, 2.0)
SKY_TO_DEG = 60.0
VIEWS_DEG = (0.0, 50.0)
ALTITUDES_M = (500.0, 3000.0, 10000.0)


def solved_in(design: AtmosphereDesign, um: float, d: Directions) -> tuple[Array, Array]:
    """Sky (zenith, azimuth, 3) and path (altitude, view, azimuth, 3) of one band. [W m⁻² sr⁻¹ µm⁻¹]"""
    one = design.model_copy(update={"wavelengths_um": (um,)})
    medium = build_medium(one, d.cos_sun_zenith)
    amounts = gas_amounts(design.water_cm)
    weights, absorption = gas_terms(amounts, medium.height_m, d.cos_sun_zenith, um)

    def repeated(values: Array, axis: int) -> Array:
        return np.repeat(values, len(weights), axis=axis)

    terms: Medium = replace(
        medium,
        wavelength_um=repeated(medium.wavelength_um, 0),
        particles={name: kind.at(np.zeros(len(weights), int)) for name, kind in medium.particles.items()},
        gas_absorption=absorption.T,
    )
    solved = solve_fields(terms, d, GROUND_ALBEDO, design.streams)
    slant = np.array(
        [[slant_weights(math.cos(v), medium.height_m, a) for v in d.view_zenith] for a in d.altitude_m]
    )
    through = np.exp(-np.einsum("avl,lt->tav", slant, solved.scattering_extinction + absorption.T))
    path = solved.upward.copy()
    path[..., 0] -= (solved.emitted[:, None, None] * through)[..., None]
    top = solar_irradiance(np.array([um]), earth_sun_distance(design))[0]
    return top * np.einsum("t,t...->...", weights, solved.sky), top * np.einsum("t,t...->...", weights, path)


@dataclass(frozen=True)
class Errors:
    """Compare one band: ratio of the tables to the solution, less 1, and difference of DoLP.

    ``sky``, ``sky_dolp``: the largest to 60° from the zenith. ``mean``: of the sky's mean radiance
    there. ``path``: (altitude, view), mean over azimuth.
    """

    sky: float
    sky_dolp: float
    mean: float
    path: Array


def compare(design: AtmosphereDesign) -> list[Errors]:
    """Errors of each band of a design."""
    tables = with_radiances(assemble_tables(design))
    zenith, view, azimuth = (tables[name].values for name in ("zenith", "view_zenith", "azimuth"))
    sun_zenith, sun_azimuth = sun_direction(design)
    from_sun = np.mod(azimuth - sun_azimuth + 1e-6, 2 * np.pi) - 1e-6
    order = np.flatnonzero(from_sun <= np.pi + 1e-6)
    order = order[np.argsort(from_sun[order])]
    near = np.flatnonzero(zenith <= math.radians(SKY_TO_DEG) + 1e-6)
    picked = [int(np.argmin(abs(view - math.radians(v)))) for v in VIEWS_DEG]
    altitudes = np.array(design.altitudes_m)
    d = Directions(math.cos(sun_zenith), zenith[near], view[picked], from_sun[order], altitudes)
    area = (np.sin(zenith[near]) * np.cos(zenith[near]))[:, None]
    found = []
    for k, um in enumerate(design.wavelength_um):
        sky, path = solved_in(design, float(um), d)
        mine = tables["sky_radiance"].values[k][near][:, order]
        ours = tables["path_radiance"].values[k][:, picked][:, :, order]
        dolp = [np.hypot(x[..., 1], x[..., 2]) / x[..., 0] for x in (mine, sky)]
        found.append(
            Errors(
                float(np.abs(mine[..., 0] / sky[..., 0] - 1).max()),
                float(np.abs(dolp[0] - dolp[1]).max()),
                float((mine[..., 0] * area).sum() / (sky[..., 0] * area).sum() - 1),
                ours[..., 0].mean(axis=-1) / path[..., 0].mean(axis=-1) - 1,
            )
        )
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bands", nargs="*", type=float, default=list(BANDS_UM))
    given = parser.parse_args()
    design = AtmosphereDesign(wavelengths_um=tuple(sorted(given.bands)), altitudes_m=ALTITUDES_M)
    heads = [f"{a:.0f} m, {v:.0f}°" for a in ALTITUDES_M for v in VIEWS_DEG]
    print("| µm | sky I, worst | DoLP | mean of I | path to " + " | ".join(heads) + " |")
    print("|" + " --- |" * (4 + len(heads)))
    for um, of in zip(design.wavelength_um, compare(design), strict=True):
        shown = " | ".join(f"{100 * error:+.1f} %" for error in of.path.ravel())
        sky = f"{100 * of.sky:.1f} % | {of.sky_dolp:.3f} | {100 * of.mean:+.1f} %"
        print(f"| {um:.2f} | {sky} | {shown} |")


if __name__ == "__main__":
    main()
