"""``glintrack scene``: build a city from data, preview it, export it, record its traffic."""

import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from rich.console import Console

from glintrack.atmosphere import AtmosphereDesign, is_solved, solve_tables
from glintrack.case.design import Case, read_table
from glintrack.cli import options as cli
from glintrack.core.designs import validate_design
from glintrack.core.units import format_duration
from glintrack.io import atomic, images
from glintrack.io.toml import to_toml
from glintrack.io.untrusted import resolve_path
from glintrack.render.preview import preview
from glintrack.results.figures.frame import azimuth_of, in_view, picture_figure
from glintrack.scene import City, SceneDesign, build_scene, fcd_table, glb, record_traffic, write_recording

app = cli.command_app("Build a city from your own data, preview it, export it.")
SceneArgument = Annotated[
    str, cli.argument("TOML file with a [scene] table, such as a case; or embedded, or braunschweig")
]


@app.command()
def build(
    output: Annotated[Path, cli.option("Case file to write", "-o", "--output")] = Path("scene.toml"),
    osm: Annotated[Path | None, cli.option("OpenStreetMap extract, .osm, .osm.gz or .osm.bz2")] = None,
    sumo_net: Annotated[str | None, cli.option("SUMO network, or sumo:PATH in the SUMO package")] = None,
    polygons: Annotated[str | None, cli.option("Polygons of SUMO's polyconvert")] = None,
    mesh: Annotated[Path | None, cli.option("Triangle mesh: .glb, .gltf, .obj, .ply or .stl")] = None,
    materials: Annotated[Path | None, cli.option("TOML file with materials and a [mesh] table")] = None,
    dem: Annotated[Path | None, cli.option("Raster of ground heights [m], with a CRS")] = None,
    traffic: Annotated[Path | None, cli.option("Floating-car data (.xml, .csv, .parquet) [m]")] = None,
    seed: Annotated[int, cli.option("Seed of everything random", min=0)] = 1,
    width: Annotated[float | None, cli.option("Window west to east [m] [default: 660 or the mesh's]")] = None,
    height: Annotated[
        float | None, cli.option("Window, south to north [m] [default: 420 or the mesh's]")
    ] = None,
    centre: Annotated[
        tuple[float, float] | None, cli.option("Centre of the window [m, m] [default: densest part]")
    ] = None,
    crs: Annotated[str | None, cli.option("Projected CRS of a mesh, such as EPSG:32632")] = None,
    origin: Annotated[tuple[float, float] | None, cli.option("Position of the mesh's origin [m, m]")] = None,
    unit: Annotated[float | None, cli.option("Length of one unit of the mesh [m]")] = None,
    up: Annotated[
        Literal["y", "z"] | None, cli.option("Axis of the mesh that points up [default: y for glTF, else z]")
    ] = None,
    trees: Annotated[bool, cli.option("Plant trees")] = True,
    buildings: Annotated[
        bool | None, cli.option("Build houses by rule where a network has none [default: if it has no house]")
    ] = None,
    sky: Annotated[bool, cli.option("Solve the sky over the city, which the first run needs")] = True,
) -> None:
    """Build a city from data, list the assumptions, write a case over it, and solve its sky."""
    atomic.check_new(output)
    cli.check_output(output)
    files = {"osm": osm, "net": sumo_net, "mesh": mesh, "polygons": polygons, "materials": materials}
    files |= {"dem": dem, "traffic": traffic}
    given = [name for name in ("osm", "net", "mesh") if files[name]]
    if len(given) > 1:
        raise ValueError(
            f"`scene build` must get one of --osm, --sumo-net, --mesh; got {' and '.join(given)}."
        )
    table = {
        "city": given[0] if given else "embedded",
        "seed": seed,
        "trees": trees,
        "fill_blocks": buildings,
        **{f"{name}_file": _absolute(file) for name, file in files.items()},
        "centre_m": centre,
        "crs": crs,
        "origin_m": origin,
        "mesh_unit_m": unit,
        "mesh_up": up,
        "width_m": width,
        "height_m": height,
    }
    design = validate_design(SceneDesign, {key: value for key, value in table.items() if value is not None})
    console = cli.open_console()
    city = _build(design, console)
    _describe(city, console)
    written = design.with_relative_files(output.parent)
    place = {"latitude_deg": round(city.latitude_deg, 4), "longitude_deg": round(city.longitude_deg, 4)}
    text = (
        "# Sensor, flight and tracker are those of quickstart: set here what differs.\n"
        f'like = "quickstart"\n\n[atmosphere]\n{to_toml(place)}\n[scene]\n{to_toml(written)}'
    )
    atomic.write_text(output, text)
    names = [name for key, name in written.model_dump().items() if key.endswith("_file") and name]
    allowed = " --allow-outside-paths" if any(Path(name).is_absolute() for name in names) else ""
    console.print(
        f"wrote {output}: try `glintrack scene preview {output} -o view.png`, "
        f"`glintrack run {output}{allowed}`"
    )
    if sky:
        _solve_sky(Case.from_toml(output, allow_outside_paths=True).atmosphere, console)


@app.command("preview")
def show(
    scene: SceneArgument,
    output: Annotated[Path, cli.option("Picture to write, .png or .jpg", "-o", "--output")],
    view: Annotated[
        Literal["plan", "oblique", "street"], cli.option("View from above, side or street")
    ] = "oblique",
    width: Annotated[int, cli.option("Width of the picture [pixel]", min=64, max=8000)] = 1600,
    time_s: Annotated[float, cli.option("Time of the traffic [s]", "--time", min=0, max=1e7)] = 30.0,
) -> None:
    """Draw a scene in natural colour, with north, sun and, seen from above or the side, a scale bar."""
    cli.check_output(output, ".png", ".jpg", ".jpeg")
    console = cli.open_console()
    city = _build(_design(scene), console)
    shown = preview(city, view, width, time_s)
    bearings = None
    if view != "street":  # between houses a length on level ground says nothing
        bearings = in_view(shown.camera, shown.pose, azimuth_of(shown.sun_direction))
    images.write_figure(output, picture_figure(shown.picture, bearings))
    rows, columns = shown.picture.shape[:2]
    console.print(f"wrote {output}: {columns} × {rows} pixels")


@app.command()
def export(
    scene: SceneArgument,
    output: Annotated[Path, cli.argument("glTF binary to write, .glb")],
    time_s: Annotated[float, cli.option("Time of the traffic [s]", "--time", min=0, max=1e7)] = 30.0,
) -> None:
    """Write a scene at one time as glTF for any viewer: colours, no spectra."""
    cli.check_output(output, ".glb")
    console = cli.open_console()
    city = _build(_design(scene), console)
    data = glb(city.at(min(time_s, city.duration_s)), city.materials)
    atomic.write_bytes(output, data)
    console.print(f"wrote {output}: {len(data) / 1e6:.1f} MB")


@app.command()
def traffic(
    output: Annotated[Path, cli.option("Recording to write (.nc, .csv, .parquet)", "-o", "--output")],
    scene: SceneArgument = "embedded",
    fcd: Annotated[Path | None, cli.option("Floating-car data to convert, without SUMO")] = None,
    duration: Annotated[float | None, cli.option("Duration that SUMO simulates [s]")] = None,
    insertion_period: Annotated[float | None, cli.option("Time between vehicles that enter [s]")] = None,
) -> None:
    """Record a scene's traffic with SUMO or from your own data, for its key `traffic_file`."""
    cli.check_output(output, ".nc", ".csv", ".parquet")
    given = {
        "traffic_file": str(resolve_path(fcd)) if fcd else None,
        "traffic_duration_s": duration,
        "traffic_insertion_period_s": insertion_period,
    }
    table = _design(scene).model_dump() | {k: v for k, v in given.items() if v is not None}
    console = cli.open_console()
    with cli.show_wait(console, "simulating traffic"):
        recording = record_traffic(validate_design(SceneDesign, table))
    if recording.traffic.first.size == 0:
        raise ValueError("`traffic` must hold at least one vehicle in the scene's window; got none.")
    if output.suffix.lower() == ".nc":
        about = {
            "title": "glintrack traffic recording",
            "source": "glintrack scene traffic",
            "licence": "that of the network and traffic it was made from",
        }
        write_recording(output, recording, about)
    elif output.suffix.lower() == ".csv":
        atomic.write_text(output, fcd_table(recording.traffic).to_csv(index=False, sep=";"))
    else:
        atomic.write_bytes(output, fcd_table(recording.traffic).to_parquet(index=False))
    for time_s in np.linspace(0, recording.traffic.duration_s, 5):
        _, states = recording.traffic.at(float(time_s))
        moving = int((np.hypot(states[:, 3], states[:, 4]) > 0.5).sum())
        console.print(f"{time_s:6.1f} s: {len(states)} vehicles, {moving} of them moving")
    if duration is not None and fcd is None and recording.traffic.duration_s > duration + 1:
        console.print(
            f"the packaged recording of {recording.traffic.duration_s:g} s is written whole "
            "(--insertion-period simulates traffic instead)"
        )
    console.print(
        f"wrote {output}: {recording.traffic.first.size} vehicles in {recording.traffic.duration_s:g} s, "
        "for `traffic_file` of the scene"
    )


def _solve_sky(design: AtmosphereDesign, console: Console) -> None:
    """Solve the sky of a case into the cache, unless it is there; warn if the sun is too low."""
    if is_solved(design):
        console.print("the sky is solved already")
        return
    started = time.perf_counter()
    try:
        with cli.Bar(console, transient=True) as bar:
            task = bar.add_task("solving the sky, once for a place and time of day", total=1.0)
            solve_tables(design, lambda done: bar.update(task, completed=done))
    except ValueError as error:
        console.print(f"warning: the sky is not solved: {error} Set [atmosphere] of the case.")
        return
    console.print(f"solved the sky in {format_duration(time.perf_counter() - started)}; runs read it again")


def _absolute(name: Path | str | None) -> str | None:
    """Return an absolute file name; one of the SUMO package stays as it is."""
    if name is None or str(name).startswith("sumo:"):
        return name if name is None else str(name)
    return str(resolve_path(name))


def _design(name: str) -> SceneDesign:
    return read_table(SceneDesign, name, "scene", "city", ("embedded", "braunschweig"))


def _build(design: SceneDesign, console: Console) -> City:
    started = time.perf_counter()
    with cli.show_wait(console, "building the city"):
        city = build_scene(design)
    console.print(f"built in {time.perf_counter() - started:.1f} s")
    return city


def _describe(city: City, console: Console) -> None:
    """Print what a city consists of, and the assumptions made for it."""

    def degrees(angle_deg: float, sides: str) -> str:
        return f"{abs(angle_deg):.4f}° {sides[angle_deg < 0]}"

    west, south, east, north = city.extent_m
    middle = city.duration_s / 2
    truth = city.truth(middle)
    moving = int((np.hypot(truth["east_speed_m_s"], truth["north_speed_m_s"]) > 0.5).sum())
    height = city.terrain["height"].values
    place = f"{degrees(city.latitude_deg, 'NS')}, {degrees(city.longitude_deg, 'EW')} ({city.crs})"
    rows = (
        ("window", f"{east - west:.0f} m × {north - south:.0f} m"),
        ("position", place),
        ("triangles", f"{len(city.static.faces):,} static, {len(city.models)} vehicle models"),
        ("vehicles", f"{truth.sizes['vehicle']} at {middle:.0f} s, {moving} of them moving"),
        ("traffic", f"{city.duration_s:.0f} s"),
        ("ground", f"{height.min():z.1f} to {height.max():z.1f} m above the centre"),
    )
    console.print(cli.make_table("scene", (), rows))
    if city.assumptions:
        console.print("assumed, because the data do not say:")
        for sentence in city.assumptions:
            console.print(f"  · {sentence}")
