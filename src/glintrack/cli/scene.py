"""``glintrack scene``: check a city and what it is made of, look at it, take it elsewhere."""

import io
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from glintrack.case.design import over_like
from glintrack.case.packaged import find_case, list_cases
from glintrack.cli.options import check_folder, command_app
from glintrack.core.designs import suggest_name, validate_design
from glintrack.io import atomic, images
from glintrack.io.toml import read_toml, to_toml
from glintrack.io.untrusted import resolve_path
from glintrack.render.preview import preview
from glintrack.results.figures.frame import azimuth_of, in_view, picture_figure
from glintrack.scene import (
    City,
    Recording,
    SceneDesign,
    build_scene,
    fcd_table,
    glb,
    record_traffic,
    write_recording,
)

app = command_app("Build a city from your own data, look at it, export it.")
# as `render.preview` has it, which takes seconds to load
View = Literal["plan", "oblique", "street"]
_PACKAGED = ("embedded", "braunschweig")
SceneArgument = Annotated[
    str,
    typer.Argument(help="TOML file with a [scene] table (a case will do), or embedded, or braunschweig."),
]


@app.command()
def build(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="TOML file to write, to be run, shown or exported")
    ] = Path("scene.toml"),
    osm: Annotated[Path | None, typer.Option(help="OpenStreetMap extract, .osm or .osm.gz")] = None,
    sumo_net: Annotated[
        str | None, typer.Option(help="SUMO network; sumo:PATH looks in the installed SUMO wheel")
    ] = None,
    polygons: Annotated[str | None, typer.Option(help="polyconvert's polygons of that network")] = None,
    mesh: Annotated[Path | None, typer.Option(help="Triangles: .glb, .gltf, .obj, .ply or .stl")] = None,
    materials: Annotated[
        Path | None, typer.Option(help="TOML with your materials, and [mesh] for a mesh's own")
    ] = None,
    dem: Annotated[Path | None, typer.Option(help="Raster of ground heights with a CRS, in m")] = None,
    traffic: Annotated[
        Path | None, typer.Option(help="Floating-car data: .xml, .csv or .parquet, in network coordinates, m")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything drawn by chance")] = 1,
    width: Annotated[
        float | None, typer.Option(help="Of the window, west to east [m] [default: 660, or the mesh's]")
    ] = None,
    height: Annotated[
        float | None, typer.Option(help="Of the window, south to north [m] [default: 420, or the mesh's]")
    ] = None,
    centre: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Middle of the window in network coordinates [m, m]; else where it is densest"),
    ] = None,
    crs: Annotated[str | None, typer.Option(help="Projected CRS, for a mesh: EPSG:32632")] = None,
    origin: Annotated[
        tuple[float, float] | None, typer.Option(help="Easting and northing of the mesh's origin [m, m]")
    ] = None,
    unit: Annotated[float | None, typer.Option(help="Length of the mesh's unit [m]")] = None,
    trees: Annotated[bool, typer.Option(help="Plant trees")] = True,
) -> None:
    """Build a city once, say what was guessed, and write the scene for `run`, `preview` and `export`."""
    if output.exists():
        raise ValueError(f"`output` must be a new file, got {output}, which exists (choose another -o)")
    check_folder(output)
    given = [name for name, value in (("osm", osm), ("net", sumo_net), ("mesh", mesh)) if value]
    if len(given) > 1:
        raise ValueError(
            f"`scene build` must get one of --osm, --sumo-net, --mesh, got {' and '.join(given)}"
        )
    table = {
        "city": given[0] if given else "embedded",
        "seed": seed,
        "trees": trees,
        "osm_file": _whole(osm),
        "net_file": _whole(sumo_net),
        "polygons_file": _whole(polygons),
        "mesh_file": _whole(mesh),
        "materials_file": _whole(materials),
        "dem_file": _whole(dem),
        "traffic_file": _whole(traffic),
        "centre_m": centre,
        "crs": crs,
        "origin_m": origin,
        "mesh_unit_m": unit,
        "width_m": width,
        "height_m": height,
    }
    design = validate_design(SceneDesign, {key: value for key, value in table.items() if value is not None})
    console = Console()
    city = _built(design, console)
    _tell(city, console)
    written = design.with_relative_files(output.parent)
    atomic.write_text(output, _case_text(city, written))
    files = [name for key, name in written.model_dump().items() if key.endswith("_file") and name]
    allowed = " --allow-outside-paths" if any(Path(name).is_absolute() for name in files) else ""
    console.print(
        f"wrote {output}: try `glintrack scene preview {output} -o view.png`, "
        f"`glintrack run {output}{allowed}`",
        soft_wrap=True,
        markup=False,
    )


def _case_text(city: City, design: SceneDesign) -> str:
    """A case over a city: its scene, the place for the sun, and all else as the quickstart has it."""
    place = {"latitude_deg": round(city.latitude_deg, 4), "longitude_deg": round(city.longitude_deg, 4)}
    return (
        "# Sensor, flight and tracker are those of quickstart: say here what differs.\n"
        f'like = "quickstart"\n\n[atmosphere]\n{to_toml(place)}\n[scene]\n{to_toml(design)}'
    )


@app.command("preview")
def show(
    scene: SceneArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture to write, .png or .jpg")],
    view: Annotated[View, typer.Option(help="From above, from the side, or from the street")] = "oblique",
    width: Annotated[int, typer.Option(min=64, max=8000, help="Of the picture [pixel]")] = 1600,
    time_s: Annotated[float, typer.Option("--time", min=0, max=1e7, help="Time of the traffic [s]")] = 30.0,
) -> None:
    """Draw a scene in natural colour, from above and from the side with north, sun and a scale bar."""
    if output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"`output` must end in .png or .jpg, got {output.name!r}")
    check_folder(output)
    console = Console()
    city = _built(_design(scene), console)
    shown = preview(city, view, width, time_s)
    lies = view != "street"  # between houses a length on level ground says nothing
    bearings = in_view(shown.camera, shown.pose, azimuth_of(shown.sun_direction)) if lies else None
    images.write_figure(output, picture_figure(shown.picture, bearings))
    rows, columns = shown.picture.shape[:2]
    console.print(f"wrote {output}: {columns} × {rows} pixels", soft_wrap=True)


@app.command()
def export(
    scene: SceneArgument,
    output: Annotated[Path, typer.Argument(help="glTF binary to write, .glb")],
    time_s: Annotated[float, typer.Option("--time", min=0, max=1e7, help="Time of the traffic [s]")] = 30.0,
) -> None:
    """Write a scene at one instant as glTF, for any viewer; colours only, no spectra."""
    if output.suffix.lower() != ".glb":
        raise ValueError(f"`output` must end in .glb, got {output.name!r}")
    check_folder(output)
    console = Console()
    city = _built(_design(scene), console)
    data = glb(city.at(min(time_s, city.duration_s)), city.materials)
    atomic.write_bytes(output, data)
    console.print(f"wrote {output}: {len(data) / 1e6:.1f} MB", soft_wrap=True)


@app.command()
def traffic(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Recording (.nc) or floating-car data (.csv, .parquet)")
    ],
    scene: SceneArgument = "embedded",
    fcd: Annotated[
        Path | None, typer.Option(help="Convert this floating-car data instead of running SUMO")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Length of SUMO's recording [s]")] = None,
    insertion_period: Annotated[
        float | None, typer.Option(help="One vehicle enters each such interval [s]")
    ] = None,
) -> None:
    """Record a scene's traffic, by SUMO or from your own data, to be named as its `traffic_file`."""
    if output.suffix.lower() not in (".nc", ".csv", ".parquet"):
        raise ValueError(f"`output` must end in .nc, .csv or .parquet, got {output.name!r}")
    check_folder(output)
    given = {
        "traffic_file": str(resolve_path(fcd)) if fcd else None,
        "traffic_duration_s": duration,
        "traffic_insertion_period_s": insertion_period,
    }
    table = _design(scene).model_dump() | {k: v for k, v in given.items() if v is not None}
    console = Console()
    with console.status("driving …"):
        recording = record_traffic(validate_design(SceneDesign, table))
    if recording.traffic.first.size == 0:
        raise ValueError("`traffic` must hold at least one vehicle in the scene's window, got none")
    _write_traffic(output, recording)
    for time_s in np.linspace(0, recording.traffic.duration_s, 5):
        _, states = recording.traffic.at(float(time_s))
        moving = int((np.hypot(states[:, 3], states[:, 4]) > 0.5).sum())
        console.print(f"{time_s:6.1f} s: {len(states)} vehicles, {moving} of them moving")
    if duration is not None and fcd is None and recording.traffic.duration_s > duration + 1:
        console.print(
            f"the tile's own recording of {recording.traffic.duration_s:g} s is written whole "
            "(--insertion-period drives anew)",
            soft_wrap=True,
        )
    console.print(
        f"wrote {output}: {recording.traffic.first.size} vehicles in {recording.traffic.duration_s:g} s, "
        "for `traffic_file` of the scene",
        soft_wrap=True,
    )


def _write_traffic(output: Path, recording: Recording) -> None:
    """In the form the file's ending names, whole or not at all."""
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
        made = io.BytesIO()
        fcd_table(recording.traffic).to_parquet(made, index=False)
        atomic.write_bytes(output, made.getvalue())


def _whole(name: Path | str | None) -> str | None:
    """A file name that holds from any folder; one of SUMO's own stays as it is."""
    if name is None or str(name).startswith("sumo:"):
        return name if name is None else str(name)
    return str(resolve_path(name))


def _design(name: str) -> SceneDesign:
    if name in _PACKAGED and not Path(name).exists():
        return validate_design(SceneDesign, {"city": name})
    if not Path(name).suffix and not Path(name).exists() and name not in list_cases():
        hint = suggest_name(name, [*_PACKAGED, *list_cases()])
        raise ValueError(f"`scene` must be a packaged city or case, or a TOML file, got {name} ({hint})")
    path = find_case(name)
    table = over_like(read_toml(path, "scene")).get("scene")
    if not isinstance(table, dict):
        raise ValueError(f"`scene` must be a TOML file with a [scene] table, got none in {name}")
    return validate_design(SceneDesign, table).resolve_files(path.parent)


def _built(design: SceneDesign, console: Console) -> City:
    started = time.perf_counter()
    with console.status("building the city …"):
        city = build_scene(design)
    console.print(f"built in {time.perf_counter() - started:.1f} s")
    return city


def _degrees(angle_deg: float, sides: str) -> str:
    """An angle on the earth, with its side: north or south, east or west."""
    return f"{abs(angle_deg):.4f}° {sides[angle_deg < 0]}"


def _tell(city: City, console: Console) -> None:
    west, south, east, north = city.extent_m
    middle = city.duration_s / 2
    truth = city.truth(middle)
    moving = int((np.hypot(truth["east_speed"], truth["north_speed"]) > 0.5).sum())
    height = city.terrain["height"].values
    table = Table(show_header=False, title="scene", title_justify="left")
    for name, value in (
        ("window", f"{east - west:.0f} m × {north - south:.0f} m"),
        ("place", f"{_degrees(city.latitude_deg, 'NS')}, {_degrees(city.longitude_deg, 'EW')} ({city.crs})"),
        ("triangles", f"{len(city.static.faces):,} that stand, {len(city.models)} vehicle models"),
        ("vehicles", f"{truth.sizes['vehicle']} at {middle:.0f} s, {moving} of them moving"),
        ("traffic", f"{city.duration_s:.0f} s"),
        ("ground", f"{height.min():z.1f} to {height.max():z.1f} m about the centre's"),
    ):
        table.add_row(name, value)
    console.print(table)
    if city.assumptions:
        console.print("assumed, because the data do not say:")
        for sentence in city.assumptions:
            console.print(f"  · {sentence}", soft_wrap=True, markup=False)
