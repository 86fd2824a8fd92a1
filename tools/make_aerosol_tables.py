"""Make src/glintrack/data/atmosphere/aerosol_components.nc: Mie scattering of the WMO basic components.

    python tools/make_aerosol_tables.py

Needs only glintrack's own dependencies (the Mie code is sasktran2's). Takes about half a minute.
"""

from pathlib import Path

import numpy as np
import xarray as xr
from sasktran2.mie.distribution import integrate_mie_cpp
from scipy.stats import lognorm

DATA = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "atmosphere"
COMPONENTS = ("dust", "water_soluble", "oceanic", "soot", "water")
COEFFICIENTS = ("a1", "a2", "a3", "b1")
MOMENTS = 128


def read_components(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Size parameters by name, wavelengths [µm] and complex indices (component, wavelength) of the CSV."""
    sizes, wavelengths, indices = {}, [], []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        name, *cells = line.split(",")
        if not name[0].isdigit():
            sizes[name] = np.array([float(cell) for cell in cells[::2]])
            continue
        wavelengths.append(float(name))
        indices.append([complex(float(n), -float(k)) for n, k in zip(cells[::2], cells[1::2], strict=True)])
    return sizes, np.array(wavelengths), np.array(indices).T


def scatter(mode_radius_um, log10_sigma, volume_um3, wavelength_um, index) -> dict[str, np.ndarray]:
    """Extinction per volume [µm⁻¹], single-scattering albedo [1] and phase moments of one component."""
    size = lognorm(log10_sigma * np.log(10), scale=mode_radius_um * 1e3)
    runs = [
        integrate_mie_cpp([size], lambda _, m=m: m, np.array([um * 1e3]), num_coeffs=MOMENTS)
        for um, m in zip(wavelength_um, index, strict=True)
    ]
    extinction = np.array([run.xs_total.item() for run in runs]) * 1e12
    albedo = np.array([run.xs_scattering.item() / run.xs_total.item() for run in runs])
    moments = np.array([[run[f"lm_{c}"].values.ravel() for c in COEFFICIENTS] for run in runs])
    return {"extinction": extinction / volume_um3, "albedo": albedo, "moments": moments}


def main() -> None:
    """Read the published figures, run Mie, write the table."""
    sizes, wavelength_um, indices = read_components(DATA / "aerosol_components.csv")
    results = [
        scatter(
            sizes["mode_radius_um"][i],
            sizes["log10_sigma"][i],
            sizes["particle_volume_um3"][i],
            wavelength_um,
            indices[i],
        )
        for i in range(len(COMPONENTS))
    ]
    table = xr.Dataset(
        {
            "extinction_per_volume": (
                ("component", "wavelength"),
                np.array([r["extinction"] for r in results]),
                {"units": "um-1", "long_name": "extinction cross section per volume of particle"},
            ),
            "single_scattering_albedo": (
                ("component", "wavelength"),
                np.array([r["albedo"] for r in results]),
                {"units": "1"},
            ),
            "moments": (
                ("component", "wavelength", "coefficient", "moment"),
                np.array([r["moments"] for r in results], dtype=np.float32),
                {"units": "1", "long_name": "generalized spherical function expansion, a1[0] = 1"},
            ),
        },
        coords={
            "component": list(COMPONENTS),
            "wavelength": ("wavelength", wavelength_um, {"units": "um"}),
            "coefficient": list(COEFFICIENTS),
        },
        attrs={
            "title": "Mie scattering of the WMO (1986) basic aerosol components",
            "source": "aerosol_components.csv through sasktran2's Mie code (tools/make_aerosol_tables.py)",
            "licence": "BSD-3-Clause, as glintrack",
        },
    )
    path = DATA / "aerosol_components.nc"
    table.to_netcdf(
        path, engine="h5netcdf", encoding={"moments": {"zlib": True, "complevel": 9, "shuffle": True}}
    )
    print(f"wrote {path} ({path.stat().st_size / 1e3:.0f} kB)")


if __name__ == "__main__":
    main()
