"""Files: the only place, beside the ``read_*`` adapters, where the product opens any."""

import csv
import glob
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import matplotlib.image
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pyproj
import rasterio
import rasterio.transform
import xarray as xr
from jaxtyping import Float
from matplotlib.figure import Figure

from glintrack.arrays import Array
from glintrack.io.untrusted import check_netcdf


class ResultFolder:
    """A result folder that appears whole: written beside its name, renamed at the end.

    Parameters
    ----------
    path
        Must not exist yet, or be an empty folder.

    Raises
    ------
    ValueError
        If the path holds something or its parent cannot be written.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.exists() and not (self.path.is_dir() and not any(self.path.iterdir())):
            raise ValueError(
                f"`output` must be a new or empty folder, got {self.path}, which exists (choose another -o)"
            )
        self.partial = self.path.with_name(f".{self.path.name}.partial-{os.getpid()}")
        shutil.rmtree(self.partial, ignore_errors=True)  # of a process that had this number and was killed
        try:
            self.partial.mkdir(parents=True)
        except OSError as error:
            raise ValueError(f"`output` must be writable, got {self.path} ({error.strerror})") from error
        self._alone()

    def _alone(self) -> None:
        """Remove what killed processes left of this folder; refuse if a living one writes it."""
        begin = f".{self.path.name}.partial-"
        for other in self.path.parent.glob(f"{glob.escape(begin)}*"):
            number = other.name.removeprefix(begin)
            if other == self.partial or not number.isdecimal():
                continue
            if _is_alive(int(number)):
                self.discard()
                raise ValueError(
                    f"`output` must not be written by another run, got {self.path}, which process {number} "
                    "writes (choose another -o, or wait)"
                )
            shutil.rmtree(other, ignore_errors=True)

    def publish(self) -> Path:
        """Give the folder its name."""
        self.partial.rename(self.path)
        return self.path

    def discard(self) -> None:
        """Remove what was written so far."""
        shutil.rmtree(self.partial, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # somebody else's
        return True
    return True


def check_new(path: Path, option: str = "output") -> None:
    """Refuse to write over a file: nobody is asked, and what lies there may be all there is of it.

    Raises
    ------
    ValueError
        If something of that name is there.
    """
    if path.exists() or path.is_symlink():
        raise ValueError(
            f"`{option}` must be a new file, got {path}, which exists (choose another, or remove it)"
        )


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    beside = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def write_picture(path: Path, picture: Float[Array, "y x 3"]) -> None:
    """Write an sRGB picture, 0 to 1, as PNG or JPEG by its ending."""
    beside = path.with_name(f".partial-{path.name}")
    quality = _JPEG if path.suffix.lower() in (".jpg", ".jpeg") else None
    try:
        matplotlib.image.imsave(beside, np.clip(picture, 0, 1), pil_kwargs=quality)
        beside.rename(path)
    finally:
        beside.unlink(missing_ok=True)


_JPEG: dict = {"quality": 82}


def write_figure(path: Path, figure: Figure, dpi: int = 150) -> None:
    """Write a figure as PNG or JPEG by its ending, whole or not at all."""
    beside = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        figure.savefig(beside, dpi=dpi)
        beside.rename(path)
    finally:
        beside.unlink(missing_ok=True)


def write_table(path: Path, rows: xr.Dataset, columns: Mapping[str, str]) -> None:
    """A dataset with dim ``row`` as CSV: column -> variable, those it has, in order."""
    if rows.sizes.get("row"):
        columns = {column: name for column, name in columns.items() if name in rows}
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        if rows.sizes.get("row"):
            values = [rows[name].values for name in columns.values()]
            writer.writerows(zip(*([_number(v) for v in column] for column in values), strict=True))


def _number(value) -> str:
    return str(int(value)) if isinstance(value, (int, np.integer)) else f"{float(value):.6g}"


def write_parquet(path: Path, rows: xr.Dataset, columns: Mapping[str, str]) -> None:
    """A dataset with dim ``row`` as Parquet: column -> variable, those it has; fields carry units."""
    columns = {column: name for column, name in columns.items() if name in rows}
    names = list(columns.values())
    units = [{"units": str(rows[name].attrs.get("units", "1"))} for name in names]
    types = [pa.from_numpy_dtype(rows[name].dtype) for name in names]
    fields = [pa.field(*field) for field in zip(columns, types, [True] * len(names), units, strict=True)]
    arrays = [pa.array(rows[name].values) for name in names]
    sink = pa.BufferOutputStream()
    pyarrow.parquet.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), sink)
    write_bytes(path, sink.getvalue().to_pybytes())


def write_cog(path: Path, image: xr.Dataset, crs: str, origin_m: tuple[float, float]) -> None:
    """A rectified frame as Cloud Optimized GeoTIFF: pan, I, Q, U and DoLP bands, NaN for no data."""
    gsd = float(image.attrs["gsd_m"])
    west = float(image["x"][0]) - gsd / 2 + origin_m[0]
    north = float(image["y"][0]) + gsd / 2 + origin_m[1]
    stokes = image["stokes_radiance"].values
    bands = {
        "pan": image["pan"].values,
        **{f"stokes_{c}": stokes[..., i] for i, c in enumerate("IQU")},
        "dolp": image["dolp"].values,
    }
    rows, columns = image["pan"].shape
    profile = {
        "driver": "COG",
        "height": rows,
        "width": columns,
        "count": len(bands),
        "dtype": "float32",
        "crs": crs,
        "transform": rasterio.transform.from_origin(west, north, gsd, gsd),
        "nodata": np.nan,
        "compress": "deflate",
    }
    with rasterio.MemoryFile() as memory:  # GDAL does not say where a disk is full
        with memory.open(**profile) as file:
            for k, (name, values) in enumerate(bands.items(), start=1):
                file.write(values.astype(np.float32), k)
                file.set_band_description(k, name)
            file.update_tags(time_s=image.attrs.get("time_s", 0.0), stokes_frame="meridian")
        write_bytes(path, memory.read())


def write_dataset(path: Path, dataset: xr.Dataset) -> None:
    """A dataset as NetCDF-4, compressed, whole or not at all."""
    encoding = {str(name): {"zlib": True} for name in dataset.data_vars}
    # made in memory: HDF5 crashes where it cannot write, on a full disk
    write_bytes(path, bytes(dataset.to_netcdf(engine="h5netcdf", encoding=encoding)))


def read_dataset(path: Path, name: str) -> xr.Dataset:
    """A NetCDF file in memory; ``name`` says what the file is in the error."""
    check_netcdf(path, name)
    try:
        with xr.open_dataset(path, engine="h5netcdf") as dataset:
            return dataset.load()
    except Exception as error:  # whatever strange attributes make the decoders say
        raise ValueError(f"`{name}` must be a readable NetCDF-4 file, got {path}: {error}") from error


def write_tree(path: Path, tree: xr.DataTree) -> None:
    """The whole result as NetCDF-4 with one group a node."""
    write_bytes(path, bytes(tree.to_netcdf(engine="h5netcdf")))


def listing(folder: Path) -> Iterable[str]:
    """Names of all files below a folder, sorted."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def write_bands(
    path: Path,
    bands: Float[Array, "y x band"],
    names: Sequence[str],
    x: Float[Array, "x"],
    y: Float[Array, "y"],
    crs: str,
    tags: Mapping[str, str | float],
) -> None:
    """A rectified picture as Cloud Optimized GeoTIFF or, by its ending, NetCDF-4; whole or not at all.

    Parameters
    ----------
    path
        ``.tif``, ``.tiff`` or ``.nc``.
    bands, names
        Values, NaN for no data, and what each band is.
    x, y
        Centres of the cells in the CRS, evenly spaced; y falls.
    crs
        Written as the raster's CRS, in NetCDF as a CF grid mapping.
    tags
        Kept with the file.

    Raises
    ------
    ValueError
        If the ending is another one.
    """
    ending = path.suffix.lower()
    if ending not in (".tif", ".tiff", ".nc"):
        raise ValueError(f"`output` must end in .tif or .nc, got {path.name!r}")
    if ending == ".nc":
        mapping = pyproj.CRS.from_user_input(crs)
        unit = "degree" if mapping.is_geographic else "m"
        dataset = xr.Dataset(
            {
                name: (("y", "x"), bands[..., k], {"grid_mapping": "spatial_ref"})
                for k, name in enumerate(names)
            },
            coords={"y": ("y", y, {"units": unit}), "x": ("x", x, {"units": unit})},
            attrs=dict(tags),
        )
        write_dataset(path, dataset.assign_coords(spatial_ref=((), 0, mapping.to_cf())))
        return
    profile = {
        "driver": "COG",
        "height": len(y),
        "width": len(x),
        "count": len(names),
        "dtype": "float32",
        "crs": pyproj.CRS.from_user_input(crs).to_wkt(),
        "transform": rasterio.transform.from_origin(
            1.5 * x[0] - 0.5 * x[1], 1.5 * y[0] - 0.5 * y[1], x[1] - x[0], y[0] - y[1]
        ),
        "nodata": np.nan,
        "compress": "deflate",
    }
    with rasterio.MemoryFile() as memory:
        with memory.open(**profile) as file:
            file.write(np.moveaxis(bands, -1, 0).astype(np.float32, copy=False))
            for k, name in enumerate(names, start=1):
                file.set_band_description(k, name)
            file.update_tags(**tags)
        write_bytes(path, memory.read())
