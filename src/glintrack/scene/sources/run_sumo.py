"""Run SUMO's own programs on a network, headless, and keep the result in the user's cache.

The installed ``eclipse-sumo`` wheel (extra ``traffic``) brings netconvert, randomTrips and sumo; nothing of
it is copied into glintrack.
"""

import importlib.metadata
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

from glintrack.core.extras import MissingExtraError, missing_extra
from glintrack.io.atomic import content_hash
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.read.sumo import read_sumo_net
from glintrack.scene.traffic import FORMAT, Recording, read_recording, write_recording
from glintrack.scene.traffic import Traffic
from glintrack.scene.vehicles import MODELS

_DEBIAN_PACKAGES = "libx11-6 libxext6 libxrender1 libgl1 libexpat1 libatomic1"
# Model, vClass and share in the traffic: mostly cars, some vans, few lorries and buses. The first mix is that
# of Braunschweig, whose published commands it follows; all else, the shipped recording too, has the full one.
Mix = tuple[tuple[str, str, float], ...]
FIRST_MIX: Mix = (
    ("car", "passenger", 0.62),
    ("hatch", "passenger", 0.18),
    ("van", "delivery", 0.10),
    ("truck", "truck", 0.05),
    ("bus", "bus", 0.05),
)
FULL_MIX: Mix = (
    ("car", "passenger", 0.42),
    ("hatch", "passenger", 0.18),
    ("suv", "passenger", 0.17),
    ("van", "delivery", 0.10),
    ("truck", "truck", 0.05),
    ("bus", "bus", 0.04),
    ("motorcycle", "motorcycle", 0.04),
)


@dataclass(frozen=True)
class SumoRun:
    """One traffic simulation, from network files to floating-car data.

    Parameters
    ----------
    inputs
        Files netconvert reads; they are copied into a scratch folder under their own names.
    netconvert
        Arguments of netconvert; the output is added.
    extent_m
        West, south, east, north in network coordinates; the traffic is kept inside. [m]
    origin_m
        Network coordinates that become (0, 0). [m]
    warmup_s
        SUMO time before the recording starts. [s]
    duration_s
        Length of the recording. [s]
    insertion_period_s
        One vehicle departs each such interval. [s]
    seed
        Of the trips.
    mix
        Model, vClass and share of the vehicles.
    """

    inputs: tuple[Path, ...]
    netconvert: tuple[str, ...]
    extent_m: tuple[float, float, float, float]
    origin_m: tuple[float, float]
    warmup_s: float
    duration_s: float
    insertion_period_s: float
    seed: int
    mix: Mix = FIRST_MIX


def sumo_home() -> Path:
    """Folder of the installed ``sumo`` package.

    Raises
    ------
    MissingExtraError
        If the extra ``traffic`` is not installed.
    """
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError(missing_extra("sumo", "traffic", "run SUMO"))
    return Path(next(iter(spec.submodule_search_locations)))


def sumo_version() -> str:
    """Version of the installed SUMO, ``"unknown"`` without one."""
    try:
        return importlib.metadata.version("eclipse-sumo")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def recorded(run: SumoRun) -> Recording:
    """The recording of a run, from the cache if it is there and whole, else simulated and cached.

    The file's name carries the run's content hash and the file's own digest; a file that does not match its
    name is rebuilt. It is written beside and renamed, so that no half-written file can be found.
    """
    key = _content_hash(run)
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "glintrack" / "traffic"
    for path in sorted(folder.glob(f"{key}-*.nc")):
        if path.stem.endswith(content_hash(path.read_bytes(), 16)):
            return read_recording(path)
        path.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="glintrack-traffic-") as scratch:
        fresh = Path(scratch) / "recording.nc"
        attributes = {"title": "glintrack traffic cache", "source": "Eclipse SUMO"}
        write_recording(fresh, simulate_traffic(run), attributes)
        try:
            _keep(folder, key, fresh)
        except OSError as error:  # a read-only home costs the next run its cache, not this one its result
            warnings.warn(f"traffic could not be cached in {folder}: {error}", stacklevel=2)
        return read_recording(fresh)  # read back, so that a first run has the millimetres of every later one


def _keep(folder: Path, key: str, fresh: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{key}-", delete=False) as beside:
        path = Path(beside.name)
    try:
        shutil.copyfile(fresh, path)
        path.replace(folder / f"{key}-{content_hash(path.read_bytes(), 16)}.nc")
    finally:
        path.unlink(missing_ok=True)


def simulate_traffic(run: SumoRun) -> Recording:
    """Build the network, draw trips, run SUMO and read what came out, in ENU about ``run.origin_m``."""
    home = sumo_home()
    end_s = run.warmup_s + run.duration_s
    with tempfile.TemporaryDirectory(prefix="glintrack-sumo-") as scratch:
        folder = Path(scratch)
        for path in run.inputs:
            shutil.copyfile(path, folder / path.name)
        (folder / "vtypes.add.xml").write_text(vehicle_types_xml(run.mix), encoding="utf-8")
        call_sumo(home, folder, [str(home / "bin" / "netconvert"), *run.netconvert, "-o", "city.net.xml"])
        trips = [sys.executable, str(home / "tools" / "randomTrips.py"), "-n", "city.net.xml"]
        trips += ["-o", "trips.xml", "-r", "routes.xml", "-b", "0", "-e", f"{end_s:g}"]
        trips += ["-p", f"{run.insertion_period_s:g}", "--fringe-factor", "5", "--min-distance", "200"]
        trips += ["--seed", str(run.seed), "--edge-permission", "passenger", "--validate"]
        trips += ["--additional-files", "vtypes.add.xml"]
        trips += ["--trip-attributes", 'type="mix" departLane="best" departSpeed="max"']
        call_sumo(home, folder, trips)
        sumo = [
            str(home / "bin" / "sumo"),
            "-n",
            "city.net.xml",
            "-r",
            "routes.xml",
            "--end",
            f"{end_s + 0.1:g}",
        ]
        sumo += ["--step-length", "0.1", "--lanechange.duration", "2.5", "--time-to-teleport", "300"]
        sumo += [
            "--fcd-output",
            "fcd.csv",
            "--device.fcd.begin",
            f"{run.warmup_s:g}",
            "--device.fcd.period",
            "0.1",
        ]
        sumo += ["--precision", "3", "--no-step-log", "--seed", str(run.seed)]
        call_sumo(home, folder, sumo)
        network, _ = read_sumo_net(folder / "city.net.xml")
        with (folder / "fcd.csv").open(encoding="utf-8") as rows:
            if "vehicle_id" not in rows.readline():  # without a vehicle SUMO names none of its columns
                raise ValueError(
                    "`scene.traffic_insertion_period_s` must let a vehicle drive while traffic is recorded, "
                    f"got none in {run.duration_s:g} s by {run.insertion_period_s:g} s (choose less)"
                )
        traffic, _ = read_fcd(folder / "fcd.csv", run.extent_m, run.warmup_s, returning=False)
    east, north = run.origin_m
    return Recording(network.shifted(-east, -north), shifted(traffic, -east, -north))


def vehicle_types_xml(mix: Mix = FIRST_MIX) -> str:
    """SUMO's description of the vehicle mix, with the dimensions of `vehicles.MODELS`."""
    lines = ['<additional><vTypeDistribution id="mix">']
    for name, vehicle_class, share in mix:
        design = MODELS[name]
        lines.append(
            f'<vType id="{name}" vClass="{vehicle_class}" length="{design.length_m}" '
            f'width="{design.width_m}" height="{design.height_m}" probability="{share}"/>'
        )
    return "\n".join([*lines, "</vTypeDistribution></additional>"])


def shifted(traffic: Traffic, east_m: float, north_m: float) -> Traffic:
    """The same traffic with its origin moved by the given vector (coordinates are added). [m]"""
    fields = {name: getattr(traffic, name) for name in traffic.__dataclass_fields__}
    fields["bumper_east"] = traffic.bumper_east + east_m
    fields["bumper_north"] = traffic.bumper_north + north_m
    return Traffic(**fields)


def call_sumo(home: Path, folder: Path, command: list[str]) -> None:
    """Run one of SUMO's programs in a folder; what goes wrong is said in one sentence.

    Raises
    ------
    MissingExtraError
        If the program or one of its system libraries is not there.
    ValueError
        With the program's own last words, if it fails.
    """
    environment = {**os.environ, "SUMO_HOME": str(home), "PROJ_LIB": str(home / "data" / "proj")}
    environment.pop("PROJ_DATA", None)  # SUMO's own PROJ reads PROJ_LIB and stumbles over a newer PROJ_DATA
    program = Path(command[1] if command[0] == sys.executable else command[0]).name
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise MissingExtraError(f"`{program}` of SUMO must be runnable, got {error}") from error
    if done.returncode == 0:
        return
    output = f"{done.stdout}\n{done.stderr}"
    if "shared libraries" in output or "cannot open shared object" in output:
        library = next((word for word in output.split() if ".so" in word), "a library").rstrip(":")
        raise MissingExtraError(
            f"`{program}` of SUMO must find its system libraries, got none for {library} "
            f"(on Debian or Ubuntu: apt-get install {_DEBIAN_PACKAGES})"
        )
    errors = [line for line in output.splitlines() if "rror" in line] or output.strip().splitlines()
    raise ValueError(
        f"`{program}` of SUMO must succeed, got exit {done.returncode}: {' '.join(errors[-2:])[:300]}"
    )


def _content_hash(run: SumoRun) -> str:
    contents = [path.read_bytes() for path in run.inputs]
    settings = {name: value for name, value in vars(run).items() if name != "inputs"}
    said = repr((FORMAT, sumo_version(), vehicle_types_xml(run.mix), sorted(settings.items())))
    return content_hash([*contents, said], 24)
