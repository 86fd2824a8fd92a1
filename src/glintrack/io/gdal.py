"""GeoTIFF and ENVI, written block by block with GDAL, as the remote-sensing programs of the field read them.

ENVI rows come band-interleaved by line where a file is written row by row (camera geometry), band-sequential
where it is written channel by channel (rectified), so that every block is one or few straight writes.
"""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.errors
import rasterio.transform
import rasterio.windows
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import RasterLayout
from glintrack.io.proj import forget_foreign_proj

forget_foreign_proj()

_NAMED = re.compile(r"description = \{.*?\}(?=\nsamples)", re.DOTALL)  # how GDAL begins the header
NO_DATA = -9999.0  # readers of ENVI headers know no NaN
_NATURAL_UM = (0.64, 0.55, 0.46)  # red, green and blue for a quick look
_CACHE_MB = 64


class _GdalWriter:
    """A raster that GDAL writes; ``profile`` are the format's own options."""

    def __init__(self, path: Path, layout: RasterLayout, profile: dict[str, Any]):
        self.layout = layout
        self.path = path
        whole = {"height": layout.rows, "width": layout.columns, "count": layout.count, "dtype": "float32"}
        if (place := layout.place) is not None:
            corner = rasterio.transform.from_origin(place.west_m, place.north_m, place.gsd_m, place.gsd_m)
            whole |= {"crs": place.crs, "transform": corner}
        # no file of GDAL's own beside
        with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB, GDAL_PAM_ENABLED=False), warnings.catch_warnings():
            # camera geometry has no place on the map, and says so in its facts
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            self.file = rasterio.open(path, "w", **{**whole, **profile})
        for k, name in enumerate(layout.band_names, start=1):
            self.file.set_band_description(k, name)

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        components, channels, rows, columns = values.shape
        window = rasterio.windows.Window(0, row, columns, rows)  # pyright: ignore[reportCallIssue]
        bands = [
            k * len(self.layout.channels) + channel + c + 1
            for k in range(components)
            for c in range(channels)
        ]
        self.file.write(np.ascontiguousarray(values.reshape(-1, rows, columns)), bands, window=window)

    def close(self) -> None:
        """Finish the file."""
        with rasterio.Env(GDAL_PAM_ENABLED=False):
            self.file.close()


class GeotiffWriter(_GdalWriter):
    """One TIFF band a flat band; 8 bits for a picture, float32 else."""

    def __init__(self, path: Path, layout: RasterLayout):
        self._picture = layout.name == "rgb"
        kind = {"dtype": "uint8", "interleave": "pixel"} if self._picture else {"interleave": "band"}
        nodata = {} if self._picture else {"nodata": np.nan}
        super().__init__(path, layout, {"driver": "GTiff", "bigtiff": "IF_SAFER", **kind, **nodata})
        for k in range(layout.count if layout.wavelength_um else 0):
            c = k % len(layout.channels)
            self.file.update_tags(
                k + 1,
                wavelength=f"{layout.wavelength_um[c]:.6g}",
                fwhm=f"{layout.width_um[c]:.6g}",
                wavelength_units="Micrometers",
            )
        facts = {**dict(layout.attributes), "units": layout.units}
        if layout.stokes_frame:
            facts["stokes_frame"] = layout.stokes_frame
        self.file.update_tags(**facts)

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        if self._picture:
            values = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
        super().write(row, channel, values)


class EnviWriter:
    """Raw float32 in ``path`` beside a text header of its name with the ending ``.hdr``.

    GDAL makes the header; the values are written straight, because GDAL says nothing of a full disk.
    """

    def __init__(self, path: Path, layout: RasterLayout):
        self.layout = layout
        self.by_line = layout.block[1] >= len(layout.channels)
        profile = {"driver": "ENVI", "interleave": "bil" if self.by_line else "bsq", "nodata": NO_DATA}
        made = _GdalWriter(path, layout, profile)
        made.file.update_tags(ns="ENVI", **envi_facts(layout))
        made.close()
        header = path.with_suffix(".hdr")  # in which GDAL has the name that the file has for now
        text = header.read_text(encoding="utf-8", errors="replace")
        header.write_text(_NAMED.sub(lambda _: _description(layout), text, count=1), encoding="utf-8")
        self._file = path.open("r+b")

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        layout = self.layout
        values = np.where(np.isfinite(values), values, NO_DATA).astype("<f4")
        components, channels, _rows, columns = values.shape
        if self.by_line:
            self._put(row * layout.count * columns, np.moveaxis(values, 2, 0))
            return
        for k in range(components):
            for c in range(channels):
                band = k * len(layout.channels) + channel + c
                self._put((band * layout.rows + row) * columns, values[k, c])

    def _put(self, first: int, values: Array) -> None:
        self._file.seek(4 * first)
        self._file.write(np.ascontiguousarray(values).data)

    def close(self) -> None:
        """Finish the data file."""
        self._file.close()


def _description(layout: RasterLayout) -> str:
    return f"description = {{glintrack {layout.name} [{layout.units}]}}"


def envi_facts(layout: RasterLayout) -> dict[str, str]:
    """What the header says beside size, type and place, so that a reader can use the raster without us."""
    facts: dict[str, str] = {}
    if layout.wavelength_um:
        repeats = len(layout.components)
        facts["wavelength_units"] = "Micrometers"
        facts["wavelength"] = _braced(f"{x:.6g}" for x in layout.wavelength_um * repeats)
        facts["fwhm"] = _braced(f"{x:.6g}" for x in layout.width_um * repeats)
        if len(layout.channels) > 3:
            nearest = [int(np.argmin(np.abs(np.array(layout.wavelength_um) - x))) + 1 for x in _NATURAL_UM]
            facts["default_bands"] = _braced(map(str, nearest))
    if layout.stokes_frame:
        facts["stokes_frame"] = layout.stokes_frame
    return facts | {name: str(value) for name, value in layout.attributes}


def _braced(items) -> str:
    return "{" + ", ".join(items) + "}"
