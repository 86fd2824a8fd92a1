"""``glintrack sensor``: list and describe sensors and lenses, and expose one frame."""

import math
from pathlib import Path
from typing import Annotated

from matplotlib.figure import Figure

from glintrack import sensor as sensing
from glintrack.case.build import trace_frame
from glintrack.case.check import assess_case
from glintrack.case.design import Case, read_case, read_table
from glintrack.case.niirs import describe_niirs
from glintrack.case.packaged import find_case
from glintrack.cli import options as cli
from glintrack.cli.case import print_judgements
from glintrack.core.designs import validate_design
from glintrack.core.spectral import wavelength_grid
from glintrack.io import atomic, images, netcdf
from glintrack.io.photographs import camera_file, pose_file
from glintrack.results.figures.sensor import draw_frame, draw_layout, draw_spots, draw_transfer
from glintrack.results.run import expose_view
from glintrack.sensor.catalogue import read_catalogue
from glintrack.sensor.derivation import derived_values
from glintrack.sensor.ghosts import SILICON
from glintrack.sensor.sensor import summary
from glintrack.sensor.wavefront import transfer_curves
from glintrack.stokes import dolp

app = cli.command_app("Describe a sensor or a lens, or expose one frame with a sensor.")
_ELECTRONS = ("full_well_e", "read_noise_e")
_LENS_FIGURES = ("focal_length_mm", "f_number", "image_circle_mm")
PrescriptionArgument = Annotated[str, cli.argument("relay, spectrometer, or a TOML file of a lens")]


@app.command("list")
def list_designs() -> None:
    """List the packaged sensors, and the real detector arrays and lenses of the catalogue."""
    console, rows = cli.open_console(), []
    for name in sensing.design_names():
        d = validate_design(sensing.SensorDesign, {"ready": name})
        lens = f"{d.focal_length_mm:g} mm F/{d.f_number:g}"
        polarizer = d.polarizer if d.has_stokes else "none"
        rows.append([name, f"{d.columns}×{d.rows}", f"{d.pitch_um:g}", lens, str(d.layout), polarizer])
    headings = ("name", "elements", "pitch µm", "lens", "superpixel", "polarizer")
    console.print(cli.make_table("packaged sensors", headings, rows, left=len(headings)))
    rows = []
    for item in read_catalogue("detectors").values():
        figures, marks = item.figures, {key: "*" * (page == "assumed") for key, page in item.sources.items()}
        cells = (f"{figures[k]:,g}{marks[k]}" if k in figures else "derived" for k in _ELECTRONS)
        size = f"{figures['columns']} × {figures['rows']}"
        rows.append([item.name, item.title, size, f"{figures['pitch_um']:g}", *cells])
    headings = ("--sensor", "detector", "elements", "pitch µm", "well e", "noise e")
    title = "detectors for glintrack case new, with full well and read noise (* assumed)"
    console.print(cli.make_table(title, headings, rows, left=3))
    lenses = read_catalogue("lenses").values()
    rows = [[item.name, item.title, *(f"{item.figures[key]:g}" for key in _LENS_FIGURES)] for item in lenses]
    headings = ("--lens", "lens", "focal mm", "smallest F", "circle mm")
    title = "lenses for glintrack case new, with the diameter of the image circle"
    console.print(cli.make_table(title, headings, rows, left=2))


@app.command()
def show(
    design: Annotated[str, cli.argument("Name of `glintrack sensor list`, or a TOML file with [sensor]")],
    mtf: Annotated[Path | None, cli.option("Figure of the MTF to write, .png")] = None,
) -> None:
    """Print derived quantities of a sensor, and judge them in the light of its case, or of quickstart."""
    arrays = read_catalogue("detectors")
    found = read_table(sensing.SensorDesign, design, "sensor", "ready", {*sensing.design_names(), *arrays})
    if mtf is not None:
        cli.check_output(mtf, ".png", option="--mtf")
    longest = max(found.band_um[1], found.spectrometer_um[1])
    sensor = sensing.build_sensor(
        found, wavelength_grid(0.4, max(math.ceil(longest * 100 - 1e-6) / 100, 0.5))
    )
    console = cli.open_console()
    console.print(cli.make_table("sensor", (), summary(sensor)))
    if found.ready in arrays:
        for key, value in arrays[found.ready].figures.items():
            console.print(f"catalogue: sensor.{key} = {value}: {arrays[found.ready].source(key)}")
    for line in derived_values(found).values():
        console.print(f"derived: {line}")
    case, name = Case().model_copy(update={"sensor": found}), "quickstart"
    if design not in (*sensing.design_names(), *arrays) and "flight" in read_case(path := find_case(design)):
        case, name = Case.from_toml(path, allow_outside_paths=True), path.stem
    judged = assess_case(case, ("sensor",))
    print_judgements(console, [one for one in judged if one.name != "car_contrast"])  # which needs a flight
    console.print(f"in the case {name}: {describe_niirs(case)}")
    if mtf is not None:
        figure = Figure(figsize=(7, 4.5), layout="constrained")
        draw_transfer(figure.subplots(), transfer_curves(sensor.design))
        images.write_figure(mtf, figure)
        console.print(f"wrote {mtf}")


@app.command()
def lens(
    prescription: PrescriptionArgument,
    spots: Annotated[Path | None, cli.option("Spot diagram to write, .png")] = None,
    layout: Annotated[Path | None, cli.option("Drawing of the lens in 3-D to write, .png")] = None,
) -> None:
    """Trace a lens: RMS spot size [µm], distortion [µm], transmitted share of the light."""
    pictures = [("--spots", spots, draw_spots), ("--layout", layout, draw_layout)]
    outputs = [(name, path, draw) for name, path, draw in pictures if path is not None]
    for name, path, _ in outputs:
        cli.check_output(path, ".png", option=name)
    design, console = sensing.read_lens(prescription), cli.open_console()
    with cli.show_wait(console, "tracing"):
        quality = sensing.lens_quality(design)
    rows = []
    for i, (x, y) in enumerate(design.fields_mm):
        one = quality.isel(field=i)
        spot = f"{float(one['spot_rms'].min()):.1f} to {float(one['spot_rms'].max()):.1f}"
        distortion, passed = 1e3 * float(one["distortion"].max()), float(one["passed"].min())
        rows.append([f"{x:g}, {y:g}", spot, f"{distortion:.1f}", f"{passed:.3f}"])
    headings = ("object mm", "RMS spot µm", "distortion µm", "transmitted")
    console.print(cli.make_table(design.name, headings, rows))
    with atomic.all_or_none(path for _, path, _ in outputs):
        for _, path, draw in outputs:
            images.write_figure(path, draw(design))
            console.print(f"wrote {path}")


@app.command("ghosts")
def list_ghosts(
    prescription: PrescriptionArgument,
    field: Annotated[int, cli.option("Index of the field point, from 0")] = 0,
    window_mm: Annotated[float, cli.option("Thickness of an N-BK7 window before the image [mm]")] = 0.0,
    gap_mm: Annotated[float, cli.option("Distance from the window to the image [mm]")] = 1.0,
    coating: Annotated[float | None, cli.option("Reflectance of its faces [default: uncoated]")] = None,
    detector: Annotated[float, cli.option("Reflectance of the detector array")] = SILICON,
    imaged: Annotated[float, cli.option("Reflectance of the object plane", "--object")] = 0.0,
    pitch_um: Annotated[float, cli.option("Pitch of the elements [µm]", min=0.01, max=1e6)] = 17.0,
) -> None:
    """List the ghosts of a lens: paths of two reflections, their light and size at the image."""
    for name, value in (("--coating", coating or 0.0), ("--detector", detector), ("--object", imaged)):
        if not 0 <= value < 1:
            raise ValueError(f"`{name}` must be at least 0 and below 1; got {value:g}.")
    design, console = sensing.read_lens(prescription), cli.open_console()
    if not 0 <= field < len(design.fields_mm):
        raise ValueError(f"`--field` must be 0 to {len(design.fields_mm) - 1}; got {field}.")
    if window_mm:
        design = sensing.with_window(design, window_mm, gap_mm, reflectance=coating)
    with cli.show_wait(console, "tracing"):
        found = sensing.ghosts(design, field, image_reflectance=detector, object_reflectance=imaged)
    last = len(design.surfaces) + 1
    names = {0: "object", last: "image"} | {k: f"surface {k}" for k in range(1, last)}
    rows = []
    for one in found:
        figures = (one.share, ".2g"), (one.spot_rms_um, ".0f"), (one.on_element(pitch_um), ".2g")
        rows.append([names[one.later], names[one.earlier], *(format(*figure) for figure in figures)])
    title = f"ghosts of {design.name}, of a point at {design.fields_mm[field]} mm"
    headings = ("1st reflection", "2nd reflection", "light / image's", "RMS spot µm", "on an element")
    console.print(cli.make_table(title, headings, rows, left=2))
    console.print(f"in a uniform scene, {sum(one.share for one in found):.2g} of the light is ghosts")


@app.command("expose")
def expose_frame(
    case: cli.CaseArgument,
    output: Annotated[Path, cli.option("Frame to write, .nc", "-o", "--output")] = Path("frame.nc"),
    frame: Annotated[int, cli.option("Index of the frame, from 0")] = 0,
    picture: Annotated[Path | None, cli.option("Figure of pan, DoLP and AoP to write, .png")] = None,
) -> None:
    """Expose one frame of a case: superpixels in W m⁻² sr⁻¹ µm⁻¹, with files of camera and true pose."""
    for name, path, suffix in (("--output", output, ".nc"), ("--picture", picture, ".png")):
        if path is not None:
            cli.check_output(path, suffix, option=name)
    design = Case.from_toml(find_case(case))
    console = cli.open_console()
    with cli.show_wait(console, "tracing a frame"):
        view = trace_frame(design, frame)
    with cli.show_wait(console, "exposing"):
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
    console.print(f"wrote {', '.join(map(str, written))}")
