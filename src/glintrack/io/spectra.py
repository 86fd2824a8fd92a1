"""Read spectra: CSV tables over wavelength, and text files of the ECOSTRESS spectral library.

Nanometres, ECOSTRESS's percent, and falling wavelengths are converted. Missing values are empty cells, or
large negative numbers such as −9999 and USGS's −1.23e34.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.installation import data_file
from glintrack.io.readings import report_reading
from glintrack.io.tables import read_csv, read_numbers
from glintrack.io.untrusted import read_text

_WAVELENGTHS = {"wavelength_um": 1.0, "wavelength_nm": 1e-3}
_MIN_UM, _MAX_UM = 0.01, 100.0  # wavelengths of others are in another unit
_MISSING = -900.0  # and below: −9999, −1.23e34
_NUMBER = r"([-+]?\d+\.?\d*(?:[eE][-+]?\d+)?)"
_ROW = re.compile(rf"^[ \t]*{_NUMBER}[ \t]+{_NUMBER}\s*$", re.MULTILINE)
_ECOSTRESS = re.compile(r"^(X Units|Y Units|Number of X Values):\s*(.*?)\s*$", re.MULTILINE)


def read_spectra(
    path: str | Path, key: str, limits: Mapping[str, tuple[float, float]], *, fill: bool = False
) -> dict[str, Float[Array, "wavelength"]]:
    """Read spectra from a CSV with a column ``wavelength_um`` or ``wavelength_nm``, or from ECOSTRESS's text.

    Parameters
    ----------
    path, key
        The file, and its key in errors. Lines of a CSV that start with ``#`` are left out. A text file
        (``.txt``) has one spectrum, ``reflectance``.
    limits
        Other columns, and the smallest and largest value of each.
    fill
        Give missing values the nearest one at the ends, and interpolate linearly between others. If False,
        they are refused.

    Returns
    -------
    Columns by name, with ``wavelength_um`` rising. [µm]

    Raises
    ------
    ValueError
        If the file cannot be read, a column is missing, a cell is not a number, wavelengths are in another
        unit or not in order, or a value lies outside its limits.
    """
    path = Path(path)
    table, notes = _read_ecostress(path, key) if path.suffix.lower() == ".txt" else (read_csv(path, key), [])
    axis = next((name for name in _WAVELENGTHS if name in table), "wavelength_um")
    if missing := [name for name in (axis, *limits) if name not in table]:
        raise ValueError(
            f"`{key}` must have columns wavelength_um and {' and '.join(limits)}; got no "
            f"{' and no '.join(missing)} among {', '.join(map(str, table)) or 'none'} in {path}."
        )
    if len(table) < 2:
        raise ValueError(f"`{key}` must have at least 2 rows; got {len(table)} in {path}.")
    values = read_numbers(table, path, (axis, *limits), finite=False)
    values[:, 0] *= _WAVELENGTHS[axis]
    if values[0, 0] > values[-1, 0]:
        values, notes = values[::-1], [*notes, "wavelengths fall: turned"]
    um, wrong = values[:, 0], ~(np.diff(values[:, 0]) > 0)
    if wrong.any():
        before, after = um[:-1][wrong][0], um[1:][wrong][0]
        raise ValueError(
            f"`{key}` must have rising or falling wavelengths; got {before:g} beside {after:g} µm in {path}."
        )
    if not _MIN_UM <= um[0] <= um[-1] <= _MAX_UM:
        other = "wavelength_nm" if um[-1] > _MAX_UM else "wavelength_um"
        raise ValueError(
            f"`{key}` must have wavelengths of {_MIN_UM:g} to {_MAX_UM:g} µm; got {um[0]:g} to {um[-1]:g} in "
            f"{path}. Perhaps its column is {other}."
        )
    spectra = {"wavelength_um": um}
    for column, (name, (least, most)) in enumerate(limits.items(), start=1):
        known = values[:, column] > _MISSING if fill else np.ones(len(um), bool)
        if not known.any():
            raise ValueError(f"`{key}` must hold measured values in column {name}; got none in {path}.")
        outside = known & ~((values[:, column] >= least) & (values[:, column] <= most))
        if outside.any():
            remedy = " Divide percent by 100." if most == 1 < values[outside, column][0] <= 100 else ""
            raise ValueError(
                f"`{key}` must have {name} within {least:g} to {most:g}; got "
                f"{values[outside, column][0]:g} at {um[outside][0]:g} µm in {path}.{remedy}"
            )
        spectra[name] = np.interp(um, um[known], values[known, column])
        notes += [f"{(~known).sum()} missing values of {name} are filled in"] * (not known.all())
    if not path.is_relative_to(data_file()):
        span = f"{um[0]:.4g} to {um[-1]:.4g} µm"
        report_reading(path, "wavelengths", len(table), len(um), notes=[span, *notes])
    return spectra


def _read_ecostress(path: Path, key: str) -> tuple[pd.DataFrame, list[str]]:
    """Read a text file of ECOSTRESS, and how its units were understood."""
    text = read_text(path, key)
    about = dict(_ECOSTRESS.findall(text))
    units = {"micrometer": "wavelength_um", "nanometer": "wavelength_nm"}
    axis = next((own for unit, own in units.items() if unit in about.get("X Units", "").lower()), None)
    quantity = about.get("Y Units", "").lower()
    if axis is None or "reflectance" not in quantity:
        raise ValueError(
            f"`{key}` must be a CSV file, or ECOSTRESS's text with X Units in micrometers or nanometers and "
            f"Y Units of reflectance; got {path}. Write a CSV with columns wavelength_um and reflectance."
        )
    rows = [(float(x), float(y)) for x, y in _ROW.findall(text)]
    table = pd.DataFrame(rows, columns=pd.Index([axis, "reflectance"]))
    if str(len(table)) != about.get("Number of X Values", str(len(table))):
        raise ValueError(
            f"`{key}` must be whole; got {len(table)} of {about['Number of X Values']} values in {path}."
        )
    if "percent" in quantity:
        table.loc[table["reflectance"] > _MISSING, "reflectance"] /= 100
    return table, [f"{about['X Units']}; {about['Y Units']}"]
