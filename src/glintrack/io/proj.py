"""The coordinate systems that GDAL reads and writes, where the environment names another PROJ's database.

SUMO's Python package, conda environments and database servers set PROJ_DATA or PROJ_LIB for a PROJ of their
own; rasterio's then knows no EPSG code, and a flight would end when its first map is written.
"""

import os
import warnings

import rasterio
from rasterio.crs import CRS
from rasterio.errors import CRSError

_VARIABLES = ("PROJ_DATA", "PROJ_LIB")


def forget_foreign_proj() -> None:
    """Take PROJ_DATA and PROJ_LIB out of the environment, and say so, if rasterio cannot read what they name.

    Called where rasterio comes in: by what reads rasters, and what writes them, whole or block by block.
    """
    named = {name: os.environ[name] for name in _VARIABLES if os.environ.get(name)}
    if not named or _knows_codes():
        return
    for name in named:
        del os.environ[name]
    if _knows_codes():
        said = " and ".join(f"{name}={value}" for name, value in named.items())
        warnings.warn(f"{said} belongs to another PROJ and is not used", stacklevel=2)
    else:
        os.environ.update(named)


def _knows_codes() -> bool:
    with rasterio.Env():  # which reads the variables
        try:
            return bool(CRS.from_epsg(4326))
        except CRSError:
            return False
