"""Optimise the example relay and spectrometer and write their prescriptions.

``python tools/optimise_lenses.py`` writes ``relay.toml`` and ``spectrometer.toml`` in
``src/glintrack/data/lenses``. Both are of Offner's form (Offner, Opt. Eng. 14, 130 (1975)): three spherical
mirrors, concentric to begin with, one to one, telecentric, free of colour. The optimiser moves two radii and
three distances for the least RMS spot over an array of 15 × 10 mm beside the axis. The spectrometer rules the
convex mirror: 0.6 µm fall on 61 elements of 17 µm (Mouroulis, Green and Chrien, Appl. Opt. 39, 2210 (2000)).
"""

from pathlib import Path

import numpy as np
from optiland import optimization

from glintrack.io.toml import to_toml
from glintrack.sensor.lens import LensDesign, LensSurface, build_optic

FOLDER = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "lenses"
RADIUS_MM = 320.0
FIELDS_MM = ((0.0, 36.0), (0.0, 41.0), (0.0, 46.0), (7.5, 36.0), (7.5, 41.0), (7.5, 46.0))
PERIOD_UM = 94.0


def start() -> LensDesign:
    """Concentric mirrors."""
    r = RADIUS_MM
    surfaces = [
        LensSurface(radius_mm=-r, thickness_mm=-r / 2, material="mirror"),
        LensSurface(radius_mm=-r / 2, thickness_mm=r / 2, material="mirror", stop=True),
        LensSurface(radius_mm=-r, thickness_mm=-r, material="mirror"),
    ]
    return LensDesign(
        name="Offner relay",
        object_distance_mm=r,
        f_number=5.6,
        telecentric=True,
        fields_mm=FIELDS_MM,
        wavelengths_um=(0.4, 0.7, 1.0),
        surfaces=tuple(surfaces),
    )


def optimise(lens: LensDesign) -> LensDesign:
    """Move radii and distances for small spots."""
    optic = build_optic(lens)
    problem = optimization.OptimizationProblem()
    reach = max(np.hypot(x, y) for x, y in lens.fields_mm)
    for x, y in lens.fields_mm:
        spot = {"Hx": x / reach, "Hy": y / reach, "num_rays": 6, "distribution": "hexapolar"}
        spot |= {"optic": optic, "surface_number": -1, "wavelength": 0.7}
        problem.add_operand("rms_spot_size", target=0, weight=1000, input_data=spot)
    for surface in (2, 3):
        problem.add_variable(optic, "radius", surface_number=surface)
    for surface in (1, 2, 3):
        problem.add_variable(optic, "thickness", surface_number=surface)
    optimization.OptimizerGeneric(problem).optimize(maxiter=150)
    surfaces = [
        surface.replace(
            {
                "radius_mm": round(float(optic.surfaces[k].geometry.radius), 5),
                "thickness_mm": round(float(np.ravel(optic.surfaces.get_thickness(k))[0]), 5),
            }
        )
        for k, surface in enumerate(lens.surfaces, start=1)
    ]
    return lens.replace({"surfaces": tuple(surfaces)})


def write(lens: LensDesign, name: str) -> None:
    """One prescription as TOML."""
    source = (
        "# source: made by tools/optimise_lenses.py of this package; lengths in mm; licence: BSD-3-Clause\n"
    )
    text = source + to_toml(lens.model_dump(mode="json", exclude_defaults=True))
    (FOLDER / f"{name}.toml").write_text(text, encoding="utf-8")


def main() -> None:
    """Optimise and write both."""
    relay = optimise(start())
    ruled = relay.surfaces[1].replace({"grating_period_um": PERIOD_UM, "grating_order": -1})
    spectrometer = relay.replace(
        {
            "name": "Offner spectrometer",
            "wavelengths_um": (0.4, 0.55, 0.7, 0.85, 1.0),
            "surfaces": (relay.surfaces[0], ruled, relay.surfaces[2]),
        }
    )
    write(relay, "relay")
    write(spectrometer, "spectrometer")


if __name__ == "__main__":
    main()
