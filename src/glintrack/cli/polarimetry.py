"""``glintrack polarimetry``: Stokes vectors, DoLP and AoP of a camera's raw mosaics."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
import xarray as xr
from rich.console import Console
from rich.progress import track as progress

from glintrack.cli.options import command_app
from glintrack.core.arrays import Array
from glintrack.core.designs import validate_design
from glintrack.io import atomic, images, netcdf
from glintrack.io.raw_mosaics import raw_files, read_raw
from glintrack.results.figures.frame import aop_colours, dolp_colours, radiance_colours
from glintrack.sensor import RawDesign, measure_polarization, read_analysers

app = command_app()
# as `sensor.layouts` has it, which takes seconds to load
Demosaicker = Literal["superpixel", "bilinear", "ppid", "eari"]


@app.command()
def polarimetry(
    raw: Annotated[
        list[Path],
        typer.Argument(
            help="Raw mosaics of one camera: 8- to 16-bit TIFF, PNG, NumPy .npy, or folders of them"
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="New folder: NAME.nc, NAME.tif (COG) and pictures of each raw"),
    ],
    layout: Annotated[
        str,
        typer.Option(
            help="Superpixel: 0-45-90-135 (Polarsens), mirror-0-60-120, or its rows, as '90 45 / 135 0' [deg]"
        ),
    ] = "0-45-90-135",
    demosaic: Annotated[Demosaicker, typer.Option(help="How elements come to one place")] = "bilinear",
    black: Annotated[float, typer.Option(help="Count without light")] = 0.0,
    white: Annotated[
        float | None, typer.Option(help="Count of a full element [default: by the bits that the frame fills]")
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option(
            help="W m⁻² sr⁻¹ µm⁻¹ a count, of unpolarized light under a polarizer [default: stay counts]"
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="NetCDF: analyser (y, x, stokes) of every element, perhaps dark (y, x)"),
    ] = None,
    dark_noise: Annotated[
        float, typer.Option("--dark-noise", help="RMS of an element in the dark [count]: masks DoLP and AoP")
    ] = 1.0,
    saturated: Annotated[
        float, typer.Option(help="Share of full elements above which to refuse a raw")
    ] = 0.05,
    rate_hz: Annotated[
        float | None, typer.Option("--rate", help="Frame rate [Hz]: writes time_s, which `track` reads")
    ] = None,
) -> None:
    """Measure polarization in raw mosaics of a camera: Stokes vectors, DoLP and AoP.

    Superpixels that use a full element are NaN.
    """
    values: dict[str, Any] = {
        "layout": _layout(layout),
        "demosaic": demosaic,
        "black_level": black,
        "white_level": white,
        "gain": gain,
        "dark_noise": dark_noise,
        "max_saturated": saturated,
    }
    design = validate_design(RawDesign, values)
    if rate_hz is not None and not 0 < rate_hz <= 1e6:
        raise ValueError(f"`rate` must be greater than 0 and at most 1e6 Hz, got {rate_hz:g}")
    known = None if calibration is None else read_analysers(calibration)
    files, console = raw_files(raw), Console()
    folder = atomic.ResultFolder(output)
    first: Array | None = None
    try:
        for k, path in enumerate(progress(files, "measuring", console=console, transient=True)):
            counts = read_raw(path)
            first = counts if first is None else first
            _check_alike(counts, first, path, files[0])
            time_s = None if rate_hz is None else k / rate_hz
            frame = measure_polarization(counts, design, known, time_s or 0.0, path)
            _write(folder.partial, path.stem, frame, time_s)
            _say(console, path, frame)
    except BaseException:
        folder.discard()
        raise
    console.print(f"wrote {folder.publish()}: {len(files)} frames", soft_wrap=True, markup=False)


def _layout(text: str) -> str | list[list[float | str]]:
    """A name, or the rows of a superpixel."""
    if "/" not in text:
        return text
    return [[_element(word) for word in re.split(r"[\s,]+", row.strip())] for row in text.split("/")]


def _element(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _check_alike(counts: Array, first: Array, path: Path, first_path: Path) -> None:
    """Refuse raws that no one camera has taken with one setting."""
    for what, mine, other in (
        ("bit depth", f"{8 * counts.dtype.itemsize} bits", f"{8 * first.dtype.itemsize} bits"),
        ("size", " × ".join(map(str, counts.shape)), " × ".join(map(str, first.shape))),
    ):
        if mine != other:
            raise ValueError(
                f"`RAW` must have one {what}, {other} as {first_path.name}, got {mine} in {path} (one camera "
                "and setting a call)"
            )


def _write(folder: Path, stem: str, frame: xr.Dataset, time_s: float | None) -> None:
    netcdf.write_dataset(folder / f"{stem}.nc", frame)
    images.write_polarization(folder / f"{stem}.tif", frame, time_s)
    degree, angle = frame["dolp"].values, frame["aop"].values
    s0 = frame["stokes_radiance"].values[..., 0]
    for name, colours in (
        ("s0", radiance_colours(s0)[0]),
        ("dolp", dolp_colours(degree)[0]),
        ("aop", aop_colours(angle, degree, 0.0)[0]),
    ):
        images.write_picture(folder / f"{stem}_{name}.png", colours)


def _say(console: Console, path: Path, frame: xr.Dataset) -> None:
    degree = frame["dolp"].values
    known = degree[np.isfinite(degree)]
    middle = f"median DoLP {np.median(known):.3f}" if known.size else "no DoLP above its floor"
    full = 100 * frame.attrs["saturated_share"]
    rows, columns = degree.shape
    console.print(
        f"{path.name}: {columns} × {rows} superpixels, {middle}, {full:.2g} % of the elements full",
        soft_wrap=True,
        markup=False,
    )
