"""``glintrack polarimetry``: Stokes vectors, DoLP and AoP of a camera's raw mosaics."""

import re
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import xarray as xr

from glintrack.cli.options import argument, command_app, open_console, option
from glintrack.core.arrays import Array
from glintrack.core.designs import validate_design
from glintrack.io import atomic, images, netcdf
from glintrack.io.raw_mosaics import raw_files, read_raw
from glintrack.results.figures.frame import aop_colours, dolp_colours, radiance_colours
from glintrack.sensor import RawDesign, measure_polarization, read_analysers

app = command_app()


@app.command()
def polarimetry(
    raw: Annotated[list[Path], argument("Raw mosaics of one camera (.tif, .png, .npy), or folders of them")],
    output: Annotated[Path, option("New folder: NetCDF, GeoTIFF and images of each raw", "-o", "--output")],
    layout: Annotated[
        str,
        option("Superpixel: 0-45-90-135 (Polarsens), mirror-0-60-120, or its rows, as '90 45 / 135 0' [deg]"),
    ] = "0-45-90-135",
    demosaic: Annotated[
        Literal["superpixel", "bilinear", "ppid", "eari"], option("Demosaicking method")
    ] = "bilinear",
    black: Annotated[float, option("Count without light")] = 0.0,
    white: Annotated[float | None, option("Count of a saturated element [default: by the bits used]")] = None,
    gain: Annotated[float | None, option("W m⁻² sr⁻¹ µm⁻¹ per count [default: keep counts]")] = None,
    calibration: Annotated[Path | None, option("NetCDF file: analyser (y, x, stokes), dark (y, x)")] = None,
    dark_noise: Annotated[float, option("RMS noise in the dark [count]; masks DoLP", "--dark-noise")] = 1.0,
    saturated: Annotated[float, option("Share of saturated elements above which a raw is refused")] = 0.05,
    rate_hz: Annotated[float | None, option("Frame rate [Hz]", "--rate", min=0.001, max=1e6)] = None,
) -> None:
    """Measure polarization in raw mosaics of a camera: Stokes vectors, DoLP and AoP.

    Superpixels that use a saturated element are NaN.
    """
    rows = [[_parse_element(word) for word in re.split(r"[\s,]+", row.strip())] for row in layout.split("/")]
    values = {
        "layout": rows if "/" in layout else layout,
        "demosaic": demosaic,
        "black_level": black,
        "white_level": white,
        "gain": gain,
        "dark_noise": dark_noise,
        "max_saturated": saturated,
    }
    design = validate_design(RawDesign, values)
    analysers = None if calibration is None else read_analysers(calibration)
    files, console = raw_files(raw), open_console()
    first: Array | None = None
    with atomic.result_folder(output) as folder:
        for k, path in enumerate(files):
            counts = read_raw(path)
            first = counts if first is None else first
            _check_same_camera(counts, first, path, files[0])
            time_s = None if rate_hz is None else k / rate_hz
            frame = measure_polarization(counts, design, analysers, time_s or 0.0, path)
            _write(folder, path.stem, frame, time_s)
            dolp = frame["dolp"].values[np.isfinite(frame["dolp"].values)]
            median = f"median DoLP {np.median(dolp):.3f}" if dolp.size else "no DoLP above its floor"
            size, full = " × ".join(map(str, frame["dolp"].shape[::-1])), 100 * frame.attrs["saturated_share"]
            console.print(f"{path.name}: {size} superpixels, {median}, {full:.2g} % of elements saturated")
    console.print(f"wrote {output}: {len(files)} frames")


def _parse_element(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _check_same_camera(counts: Array, first: Array, path: Path, first_path: Path) -> None:
    """Refuse raws that no one camera has taken with one setting."""
    for what, mine, other in (
        ("bit depth", f"{8 * counts.dtype.itemsize} bits", f"{8 * first.dtype.itemsize} bits"),
        ("size", " × ".join(map(str, counts.shape)), " × ".join(map(str, first.shape))),
    ):
        if mine != other:
            raise ValueError(
                f"`RAW` must have one {what}, {other} as {first_path.name}; got {mine} in {path}. Call it "
                "once for each camera and setting."
            )


def _write(folder: Path, stem: str, frame: xr.Dataset, time_s: float | None) -> None:
    netcdf.write_dataset(folder / f"{stem}.nc", frame)
    images.write_polarization(folder / f"{stem}.tif", frame, time_s)
    degree, angle = frame["dolp"].values, frame["aop"].values
    colours = {
        "s0": radiance_colours(frame["stokes_radiance"].values[..., 0]),
        "dolp": dolp_colours(degree),
        "aop": aop_colours(angle, degree, 0.0),
    }
    for name, (picture, *_) in colours.items():
        images.write_picture(folder / f"{stem}_{name}.png", picture)
