"""ENVI rasters: raw float32 beside a text header, as the remote-sensing programs of the field read them.

Rows come band-interleaved by line where a file is written row by row (camera geometry), band-sequential where
it is written channel by channel (rectified), so that every block is one or few straight writes.
"""

from pathlib import Path

import numpy as np
import pyproj
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.records import GroundPlace, RasterLayout

NO_DATA = -9999.0  # header readers know no NaN
_NATURAL_UM = (0.64, 0.55, 0.46)  # red, green and blue for a quick look


class EnviWriter:
    """Write a raster block by block: ``data`` beside ``header``, both at paths not yet published.

    Parameters
    ----------
    header, data
        Where to write.
    layout
        What the file holds.
    """

    def __init__(self, header: Path, data: Path, layout: RasterLayout):
        self.layout = layout
        self.by_line = layout.block[1] >= len(layout.channels)
        header.write_text(header_text(layout, self.by_line), encoding="utf-8")
        self._file = data.open("wb")
        self._file.truncate(4 * layout.count * layout.rows * layout.columns)

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        layout = self.layout
        values = np.where(np.isfinite(values), values, NO_DATA).astype("<f4")
        components, channels, _rows, columns = values.shape
        if self.by_line:
            self._file.seek(4 * row * layout.count * columns)
            self._file.write(np.ascontiguousarray(np.moveaxis(values, 2, 0)).data)
            return
        for k in range(components):
            for c in range(channels):
                band = k * len(layout.channels) + channel + c
                self._file.seek(4 * (band * layout.rows + row) * columns)
                self._file.write(np.ascontiguousarray(values[k, c]).data)

    def close(self) -> None:
        """Finish the data file."""
        self._file.close()


def header_text(layout: RasterLayout, by_line: bool) -> str:
    """The header, every field that a reader needs to use the raster without us."""
    repeats = len(layout.components)
    fields: list[tuple[str, str]] = [
        ("description", "{" + f"glintrack {layout.name} [{layout.units}]" + "}"),
        ("samples", str(layout.columns)),
        ("lines", str(layout.rows)),
        ("bands", str(layout.count)),
        ("header offset", "0"),
        ("file type", "ENVI Standard"),
        ("data type", "4"),
        ("interleave", "bil" if by_line else "bsq"),
        ("byte order", "0"),
        ("data ignore value", f"{NO_DATA:g}"),
        ("band names", _braced(layout.band_names)),
    ]
    if layout.wavelength_um:
        fields += [
            ("wavelength units", "Micrometers"),
            ("wavelength", _braced(f"{x:.6g}" for x in layout.wavelength_um * repeats)),
            ("fwhm", _braced(f"{x:.6g}" for x in layout.width_um * repeats)),
        ]
        if len(layout.channels) > 3:
            nearest = [int(np.argmin(np.abs(np.array(layout.wavelength_um) - x))) + 1 for x in _NATURAL_UM]
            fields.append(("default bands", _braced(map(str, nearest))))
    if layout.stokes_frame:
        fields.append(("stokes frame", layout.stokes_frame))
    fields += [(name.replace("_", " "), str(value)) for name, value in layout.attributes]
    if layout.place is not None:
        fields += [
            ("map info", _map_info(layout.place)),
            ("coordinate system string", "{" + _esri_wkt(layout.place.crs) + "}"),
        ]
    return "ENVI\n" + "".join(f"{name} = {value}\n" for name, value in fields)


def _braced(items) -> str:
    return "{" + ", ".join(items) + "}"


def _esri_wkt(crs: str) -> str:
    return pyproj.CRS.from_user_input(crs).to_wkt("WKT1_ESRI")


def _map_info(place: GroundPlace) -> str:
    """Pixel (1, 1) is the first cell's outer corner, as ENVI counts."""
    crs = pyproj.CRS.from_user_input(place.crs)
    corner = f"1, 1, {place.west_m:.4f}, {place.north_m:.4f}, {place.gsd_m:g}, {place.gsd_m:g}"
    zone = crs.utm_zone
    if zone:
        side = "North" if zone.endswith("N") else "South"
        return "{" + f"UTM, {corner}, {zone[:-1]}, {side}, WGS-84, units=Meters" + "}"
    return "{" + f"{crs.name.replace(',', ' ')}, {corner}, units=Meters" + "}"
