"""``glintrack sensor``: the ready designs, what follows from a design, and one frame exposed by it."""

import math
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import typer
from rich.console import Console
from rich.table import Table

from glintrack.case.build import trace_frame
from glintrack.case.design import Case, over_like
from glintrack.case.packaged import find_case, list_cases
from glintrack.cli.options import CaseArgument, command_app
from glintrack.core.designs import suggest_name, validate_design
from glintrack.core.spectral import wavelength_grid
from glintrack.io import atomic, images, netcdf
from glintrack.io.photographs import camera_file, pose_file
from glintrack.io.toml import read_toml
from glintrack.results.figures.sensor import draw_frame, draw_layout, draw_spots, draw_transfer
from glintrack.results.run import expose_view
from glintrack.sensor import (
    SensorDesign,
    build_sensor,
    design_names,
    ghosts,
    lens_quality,
    read_lens,
    with_window,
)
from glintrack.sensor.sensor import summary
from glintrack.sensor.wavefront import transfer_curves
from glintrack.stokes import dolp

app = command_app("Look at a sensor's design, or expose one frame with it.")
SILICON = 0.35  # reflectance, as `sensor.ghosts` has it, which takes seconds to load
DesignArgument = Annotated[
    str, typer.Argument(help="A ready design by name, or a TOML file with a [sensor] table (a case will do).")
]


@app.command("list")
def list_designs() -> None:
    """List the ready designs, with their elements and superpixels."""
    table = Table(title="ready designs", title_justify="left")
    for heading in ("name", "elements", "pitch µm", "focal length mm", "F", "superpixel", "polarizer"):
        table.add_column(heading)
    for name in design_names():
        d = validate_design(SensorDesign, {"ready": name})
        table.add_row(
            name,
            f"{d.columns} × {d.rows}",
            f"{d.pitch_um:g}",
            f"{d.focal_length_mm:g}",
            f"{d.f_number:g}",
            str(d.layout),
            d.polarizer if d.has_stokes else "none",
        )
    Console().print(table)


@app.command()
def show(
    design: DesignArgument,
    mtf: Annotated[Path | None, typer.Option(help="Plot of the modulation transfer to write, .png")] = None,
) -> None:
    """Say what follows from a design: resolution, electrons, noise, polarizers, modulation transfer."""
    found = _design(design)
    longest = max(found.band_um[1], found.spectrometer_um[1])
    sensor = build_sensor(found, wavelength_grid(0.4, max(math.ceil(longest * 100 - 1e-6) / 100, 0.5)))
    console = Console()
    table = Table(show_header=False, title="sensor", title_justify="left")
    for name, value in summary(sensor):
        table.add_row(name, value)
    console.print(table)
    if mtf is not None:
        if mtf.suffix.lower() != ".png" or not mtf.parent.is_dir():
            raise ValueError(f"`--mtf` must end in .png and lie in an existing folder, got {mtf}")
        figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
        draw_transfer(axes, transfer_curves(sensor.design))
        images.write_figure(mtf, figure)
        plt.close(figure)
        console.print(f"wrote {mtf}", soft_wrap=True, markup=False)


@app.command()
def lens(
    prescription: Annotated[
        str, typer.Argument(help="relay, spectrometer, or a TOML file: surfaces in mm, wavelengths in µm")
    ],
    spots: Annotated[Path | None, typer.Option(help="Spot diagram to write, .png")] = None,
    layout: Annotated[Path | None, typer.Option(help="Picture in three dimensions to write, .png")] = None,
) -> None:
    """Trace a lens prescription: RMS spots [µm], distortion [µm], share of light that passes."""
    for name, path in (("--spots", spots), ("--layout", layout)):
        if path is not None and (path.suffix.lower() != ".png" or not path.parent.is_dir()):
            raise ValueError(f"`{name}` must end in .png and lie in an existing folder, got {path}")
    design, console = read_lens(prescription), Console()
    with console.status("tracing …"):
        quality = lens_quality(design)
    table = Table(title=design.name, title_justify="left")
    for heading in ("object mm", "RMS spot µm", "distortion µm", "passed"):
        table.add_column(heading, justify="right")
    for i, (x, y) in enumerate(design.fields_mm):
        one = quality.isel(field=i)
        table.add_row(
            f"{x:g}, {y:g}",
            f"{float(one['spot_rms'].min()):.1f} to {float(one['spot_rms'].max()):.1f}",
            f"{1e3 * float(one['distortion'].max()):.1f}",
            f"{float(one['passed'].min()):.3f}",
        )
    console.print(table)
    asked = [(path, draw) for path, draw in ((spots, draw_spots), (layout, draw_layout)) if path is not None]
    with atomic.all_or_none(path for path, _ in asked):
        for path, draw in asked:
            figure = draw(design)
            images.write_figure(path, figure)
            plt.close(figure)
            console.print(f"wrote {path}", soft_wrap=True, markup=False)


@app.command("ghosts")
def list_ghosts(
    prescription: Annotated[
        str, typer.Argument(help="relay, spectrometer, or a TOML file: surfaces in mm, wavelengths in µm")
    ],
    field: Annotated[int, typer.Option(help="Which of its fields, from 0")] = 0,
    window_mm: Annotated[
        float, typer.Option(help="Thickness of a window of N-BK7 put before the image; 0 for none")
    ] = 0.0,
    gap_mm: Annotated[float, typer.Option(help="From that window to the image")] = 1.0,
    coating: Annotated[
        float | None, typer.Option(help="Reflectance of each face of that window [default: bare glass's]")
    ] = None,
    detector: Annotated[float, typer.Option(help="Reflectance of the detector; bare silicon's")] = SILICON,
    imaged: Annotated[float, typer.Option("--object", help="Reflectance of the plane that is imaged")] = 0.0,
    pitch_um: Annotated[float, typer.Option(help="Of the elements that ghosts are compared on")] = 17.0,
) -> None:
    """List a prescription's ghosts: paths of two reflections, their light and size at the image."""
    for name, value in (("--coating", coating or 0.0), ("--detector", detector), ("--object", imaged)):
        if not 0 <= value < 1:
            raise ValueError(f"`{name}` must be at least 0 and below 1, got {value:g}")
    design, console = read_lens(prescription), Console()
    if not 0 <= field < len(design.fields_mm):
        raise ValueError(f"`--field` must be 0 to {len(design.fields_mm) - 1}, got {field}")
    if not 0 < pitch_um <= 1e6:
        raise ValueError(f"`--pitch-um` must be above 0 and at most 1e6, got {pitch_um:g}")
    if window_mm:
        design = with_window(design, window_mm, gap_mm, reflectance=coating)
    with console.status("tracing …"):
        found = ghosts(design, field, image_reflectance=detector, object_reflectance=imaged)
    last = len(design.surfaces) + 1
    names = {0: object, last: "image"} | {k: f"surface {k}" for k in range(1, last)}
    table = Table(title=f"ghosts of {design.name}, of a point at {design.fields_mm[field]} mm")
    for heading in ("back at", "forth at", "light, of the image's", "RMS spot µm", "on an element"):
        table.add_column(heading, justify="right")
    for ghost in found:
        table.add_row(
            names[ghost.later],
            names[ghost.earlier],
            f"{ghost.share:.2g}",
            f"{ghost.spot_rms_um:.0f}",
            f"{ghost.on_element(pitch_um):.2g}",
        )
    console.print(table)
    console.print(f"in an even scene, {sum(ghost.share for ghost in found):.2g} of the light is ghosts'")


@app.command("expose")
def expose_frame(
    case: CaseArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="Frame to write, .nc")] = Path("frame.nc"),
    frame: Annotated[int, typer.Option(help="Which frame of the flight, from 0")] = 0,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of pan, DoLP and angle of polarization to write, .png")
    ] = None,
) -> None:
    """Expose one frame of a case: superpixels in W m⁻² sr⁻¹ µm⁻¹, camera and true pose beside them."""
    for name, path, suffix in (("--output", output, ".nc"), ("--picture", picture, ".png")):
        if path is not None and (path.suffix.lower() != suffix or not path.parent.is_dir()):
            raise ValueError(f"`{name}` must end in {suffix} and lie in an existing folder, got {path}")
    design = Case.from_toml(find_case(case))
    console = Console()
    with console.status("building the city and tracing …"):
        view = trace_frame(design, frame)
    with console.status("exposing …"):
        found = expose_view(design, view)
    exposed = found.frame
    camera_path, pose_path = output.with_suffix(".camera.toml"), output.with_suffix(".pose.toml")
    written = [output, camera_path, pose_path, *([picture] if picture else [])]
    with atomic.all_or_none(written):
        netcdf.write_dataset(output, exposed)
        atomic.write_text(camera_path, camera_file(found.camera))
        atomic.write_text(pose_path, pose_file(found.pose))
        if picture is not None:
            figure = draw_frame(exposed, dolp(exposed["stokes_radiance"].values, exposed.attrs["dolp_floor"]))
            images.write_figure(picture, figure)
            plt.close(figure)
    console.print(f"wrote {', '.join(map(str, written))}", soft_wrap=True, markup=False)


def _design(name: str) -> SensorDesign:
    if name in design_names() and not Path(name).exists():
        return validate_design(SensorDesign, {"ready": name})
    if not Path(name).suffix and not Path(name).exists() and name not in list_cases():
        hint = suggest_name(name, [*design_names(), *list_cases()])
        raise ValueError(
            f"`sensor` must be a ready design, a packaged case or a TOML file, got {name} ({hint})"
        )
    path = find_case(name)
    table = over_like(read_toml(path, "sensor")).get("sensor")
    if not isinstance(table, dict):
        raise ValueError(
            f"`sensor` must be one of {', '.join(design_names())} or a TOML file with a [sensor] table, "
            f"got {name}"
        )
    return validate_design(SensorDesign, table).resolve_files(path.parent)
