"""A valid call of every command, with the files it reads and what it writes.

A word that begins with ``@`` is a file or folder that is read, one with ``>`` what is written. A test refuses
a command that has no call here, so that it too is tried with hostile files and on full disks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from glintrack.io import netcdf
from glintrack.study import StudyFolder, read_plan, run_study, serial, write_results
from tests.conftest import flat_sky
from tests.fuzz import readers
from tests.report.made import write_small_result
from tests.study.cases import TWELVE, cheap, write_study

SMALL = """name = "three cars"
channels = ["pan"]
[flight]
off_nadir_deg = 0.0
altitude_m = 6000.0
frames = 3
[sensor]
rows = 120
columns = 160
oversampling = 1
polarizer = "ideal"
demosaic = "bilinear"
[bound]
every = 1
"""
OPTIMIZATION = """case = "case.toml"
require = ["custody >= 0.01"]
candidates = 16
[axes]
flight.rate_hz = { from = 1.0, to = 2.0 }
"""
STUDY = 'case = "case.toml"\n[axes]\n"sensor.pitch_um" = [17.0]\n'
MESH_SCENE = """[scene]
city = "mesh"
mesh_file = "mesh.obj"
mesh_up = "z"
materials_file = "materials.toml"
crs = "EPSG:32618"
origin_m = [287900.0, 4779100.0]
"""


def _write_study(path: Path) -> None:
    """A finished study of cases that cost nothing."""
    scratch = path.with_name(f"{path.name}-made-from")
    plan, folder = read_plan(write_study(scratch, TWELVE)), StudyFolder(path)
    with folder.open(plan), serial() as pool:
        run_study(plan, folder, pool, scratch, simulate=cheap)
        write_results(plan, folder)


FILES: Mapping[str, Callable[[Path], None]] = {
    "case.toml": readers.text(SMALL),
    "study.toml": readers.text(STUDY),
    "optimization.toml": readers.text(OPTIMIZATION),
    "scene.toml": readers.text(MESH_SCENE),
    "mesh.obj": readers.text(readers.OBJ),
    "materials.toml": readers.text(readers.MATERIALS),
    "net.xml": readers.text(readers.NET),
    "polygons.xml": readers.text(readers.POLY),
    "fcd.csv": readers.text(readers.FCD),
    "dem.tif": readers.write_dem,
    "frame.tif": readers.write_frame,
    "picture.png": readers.write_picture,
    "stack.nc": readers.write_stack,
    "raw.png": readers.write_raw,
    "calibration.nc": readers.write_analysers,
    "detections.csv": readers.text(readers.DETECTIONS),
    "tracks.csv": readers.text(readers.TRACKS),
    "truth.csv": readers.text(readers.TRUTH),
    "camera.toml": readers.text("focal_length_mm = 20.0\npitch_um = 10.0\nrows = 24\ncolumns = 32\n"),
    "pose.toml": readers.text(
        'crs = "EPSG:32618"\neasting_m = 0.0\nnorthing_m = 0.0\nheight_m = 900.0\nheading_deg = 10.0\n'
        'roll_deg = 1.0\npitch_deg = -2.0\norder = "heading-roll-pitch"\n'
    ),
    "grid.toml": readers.text(readers.GRID),
    "etalon.toml": readers.text("wavelength_step_um = 0.1\n"),
    "mirror.toml": readers.text(readers.MIRROR),
    "lens.toml": readers.text(readers.LENS),
    "sky.nc": lambda path: netcdf.write_dataset(path, flat_sky(sun=1.0, sky_radiance=1.0, path=0.1)),
    "result": lambda path: write_small_result(path) and None,
    "study": _write_study,
}


@dataclass(frozen=True)
class Call:
    """One way to call a command.

    Parameters
    ----------
    command
        Its words.
    arguments
        After them.
    ends
        Whether it ends by itself when all is well.
    refused
        Whether what it needs (an extra, a finished study) may be missing here, so that exit 2 is right too.
    """

    command: str
    arguments: tuple[str, ...] = ()
    ends: bool = True
    refused: bool = False

    @property
    def reads(self) -> list[str]:
        """Names of files it reads."""
        return [word[1:] for word in self.arguments if word.startswith("@")]

    @property
    def writes(self) -> list[str]:
        """Names of what it writes."""
        return [word[1:] for word in self.arguments if word.startswith(">")]


def _call(line: str, **more) -> Call:
    words = line.split()
    plain = 2 if words[0] in GROUPS else 1
    return Call(" ".join(words[:plain]), tuple(words[plain:]), **more)


GROUPS = ("study", "dataset", "case", "scene", "atmosphere", "sensor", "device")
CALLS = (
    _call("run @case.toml -o >flown --force"),
    _call("case check @case.toml --json"),
    _call("report @result -o >page.html"),
    _call("report @study -o >page.html"),
    _call("view @result --port 0", ends=False),
    _call("video @result -o >film.gif --width 160"),
    _call("video @result -o >film.mp4 --width 160", refused=True),
    _call("study run @study.toml -o >studied --serial --cache >kept"),
    _call("study report @study"),
    _call("optimize @optimization.toml --dry-run"),
    _call("case list"),
    _call("case new >mycam.toml --pixels 64x64 --pitch 10 --focal-length 50 --altitude 1000 --rate 2"),
    _call("warm-up"),
    _call("case check @case.toml"),
    _call("case check @scene.toml"),
    _call("case schema"),
    _call("track @detections.csv -o >tracked --crs EPSG:32618"),
    _call("track @stack.nc -o >tracked --rate 2 --geotransform 0 100 1.5", refused=True),
    _call("bound @case.toml --frames 2 -o >budget.nc"),
    _call("score @tracks.csv @truth.csv --json >scores.json"),
    _call("ortho @picture.png --camera @camera.toml --pose @pose.toml --height 10 -o >ortho.tif"),
    _call("ortho @picture.png --camera @camera.toml --pose @pose.toml --dem @dem.tif -o >ortho.nc"),
    _call(
        "ortho @picture.png --camera @camera.toml --pose @pose.toml --height 10 --register @dem.tif -o >o.tif"
    ),
    _call("dataset build @case.toml -o >labelled --frames 2"),
    _call("dataset baseline @result", refused=True),
    _call("dataset label @stack.nc -o >labels.html --rate 2 --geotransform 0 100 1.5"),
    _call("polarimetry @raw.png -o >measured --calibration @calibration.nc"),
    _call("render @case.toml -o >picture.png"),
    _call("render @case.toml --band 0.6:0.7 -o >bands.tif"),
    _call("render @case.toml --cube -o >cube.nc"),
    _call("render @case.toml --cube -o >cube.hdr"),
    _call("render @case.toml --cube -o >cube.zarr"),
    _call("scene build --mesh @mesh.obj --materials @materials.toml --crs EPSG:32618 "
          "--origin 287900 4779100 --no-sky -o >built.toml"),
    _call("scene build --sumo-net @net.xml --polygons @polygons.xml --traffic @fcd.csv --no-sky "
          "-o >built.toml", refused=True),
    _call("scene preview @scene.toml -o >view.png --width 64"),
    _call("scene export @scene.toml >scene.glb"),
    _call("scene traffic embedded --fcd @fcd.csv -o >traffic.csv", refused=True),
    _call("scene traffic embedded -o >traffic.nc"),
    _call("scene traffic embedded -o >traffic.parquet"),
    _call("atmosphere solve @case.toml -o >solved.nc"),
    _call("atmosphere plot @sky.nc -o >sky.png"),
    _call("sensor list"),
    _call("sensor show @case.toml --mtf >mtf.png"),
    _call("sensor lens @lens.toml --spots >spots.png --layout >layout.png", refused=True),
    _call("sensor ghosts @lens.toml", refused=True),
    _call("sensor expose @case.toml -o >frame.nc --picture >frame.png"),
    _call("device wiregrid grid_a -o >grid.nc --step-um 0.1"),
    _call("device wiregrid @grid.toml -o >grid.nc --start-um 1.0 --stop-um 1.1 --step-um 0.1", refused=True),
    _call("device etalon @etalon.toml -o >etalon.nc --plot"),
    _call("device micromirror @mirror.toml -o >mirror.nc --plot --glb >mirror.glb", refused=True),
)  # fmt: skip


def write_files(folder: Path) -> None:
    """Every file that a call reads."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, write in FILES.items():
        write(folder / name)
