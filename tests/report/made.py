"""A small result folder made by hand, with counts known beforehand."""

import json
from importlib.metadata import version

import numpy as np
import xarray as xr

from glintrack import Case
from glintrack.io import atomic, netcdf
from glintrack.io.toml import to_toml
from glintrack.results.film import FILM_BYTES, Film, picture_name

TIMES_S = np.arange(6) * 0.5
EXTENT_M = (-60.0, -40.0, 60.0, 40.0)
GSD_M = 2.0
WAVELENGTH_UM = np.linspace(0.4, 1.0, 7)
__all__ = ["FILM_BYTES", "xr"]  # what tests of the page use from here
TRACKS, VEHICLES, QUERIES = 2, 3, 4
FIRST_X_M, FIRST_Y_M, SPEED_M_S = -40.0, 10.0, 10.0


def image(seed=0, polarized=True):
    """A rectified frame with a hole at its north-west corner."""
    rng = np.random.default_rng(seed)
    columns, rows = int((EXTENT_M[2] - EXTENT_M[0]) / GSD_M), int((EXTENT_M[3] - EXTENT_M[1]) / GSD_M)
    pan = rng.uniform(10, 90, (rows, columns))
    stokes = np.stack([pan, 0.2 * pan, 0.1 * pan], axis=-1)
    pan[:3, :3] = np.nan
    stokes[:3, :3] = np.nan
    if not polarized:
        stokes[...] = np.nan
    return xr.Dataset(
        {
            "pan": (("y", "x"), pan),
            "stokes_radiance": (("y", "x", "stokes"), stokes),
            "dolp": (("y", "x"), np.hypot(stokes[..., 1], stokes[..., 2]) / stokes[..., 0]),
        },
        attrs={"gsd_m": GSD_M},
    )


def rows(ids, places, **columns):
    """One row an id and epoch, all driving east."""
    t = np.repeat(TIMES_S, len(ids))
    x = np.concatenate([places[:, 0] + SPEED_M_S * time for time in TIMES_S])
    y = np.tile(places[:, 1], len(TIMES_S))
    values = {
        "time_s": t,
        "east_m": x,
        "north_m": y,
        "east_speed_m_s": np.full(len(t), SPEED_M_S),
        "north_speed_m_s": np.zeros(len(t)),
        **columns,
    }
    return xr.Dataset({k: ("row", np.asarray(v)) for k, v in values.items()})


def tree(name="small"):
    """Two tracks, the second of which changes from vehicle 22 to 33 half way."""
    places = np.array([[FIRST_X_M, FIRST_Y_M], [-30.0, -20.0], [-20.0, -22.0]])
    truth = rows([11, 22, 33], places, vehicle_id=np.tile([11, 22, 33], 6), visible_fraction=np.ones(18))
    swapped = np.where(np.arange(6) < 3, 22, 33)
    tracks = rows(
        [4, 7],
        places[:2],
        track_id=np.tile([4, 7], 6),
        vehicle_id=np.stack([np.full(6, 11), swapped], axis=1).ravel(),
        valid=np.ones(12, int),
        false=np.zeros(12, int),
        status=np.tile(["measured", "coasted"], 6),
    )
    curves = {
        "completeness": np.linspace(0.2, 0.7, 6),
        "purity": np.linspace(1, 0.75, 6),
        "false_tracks": np.zeros(6),
        "valid": np.full(6, 2.0),
        "queries_served": np.full(6, 1.0),
    }
    queries = xr.Dataset(
        {
            "time_s": ("row", TIMES_S[2:]),
            "track_id": ("row", [4, 4, 7, -1]),
            "vehicle_id": ("row", [11, 11, 22, -1]),
            "east_m": ("row", np.zeros(4)),
            "north_m": ("row", np.zeros(4)),
            "radiance": (("row", "wavelength"), np.outer([1, 3, 5, 7], np.ones(7)).astype(np.float32)),
        },
        coords={"wavelength": WAVELENGTH_UM},
    )
    scores = {"completeness": 0.45, "purity": 0.75, "false_per_frame": 0.0, "identity_switches": 1.0}
    quality = xr.Dataset({"psnr": ("time", np.full(6, 30.0), {"units": "dB"})}, coords={"time": TIMES_S})
    froc = xr.Dataset(
        {
            "completeness": ("threshold", [0.6, 0.5, 0.2]),
            "false_per_frame": ("threshold", [4.0, 1.0, 0.0]),
            "purity": ("threshold", [0.7, 0.8, np.nan]),
        },
        coords={"threshold": ("threshold", [0.0, 0.06, 0.4], {"key": "reporting.max_false_share"})},
    )
    vehicles = xr.Dataset(
        {"paint": ("vehicle", np.array(["red", "blue", "blue"], object))}, coords={"vehicle": [11, 22, 33]}
    )
    return xr.DataTree.from_dict(
        {
            "/": xr.Dataset(attrs={"case": name}),
            "/pan": xr.Dataset({k: ("time", v) for k, v in curves.items()}, {"time": TIMES_S}, scores),
            "/pan/tracks": tracks,
            "/pan/queries": queries,
            "/pan/quality": quality,
            "/pan/froc": froc,
            "/truth": truth,
            "/vehicles": vehicles,
        }
    )


def named(name):
    """A case of any name, also of one that a case may not have."""
    return Case.model_construct(**dict(Case()) | {"name": name})


def write_small_result(folder, name="small", written_by=None, case=None):
    """A whole result folder."""
    folder.mkdir(parents=True)
    case = case or Case(name=name, seed=7)
    atomic.write_text(folder / "case.toml", to_toml(case))
    facts = {"case": name, "glintrack_version": written_by or version("glintrack"), "interrupted": 0}
    atomic.write_text(
        folder / "provenance.toml", "".join(f"{k} = {json.dumps(v)}\n" for k, v in facts.items())
    )
    netcdf.write_tree(folder / "result.nc", tree(name))
    film = Film.of(6, 3)
    (folder / "film").mkdir()
    for k in sorted(film.frames):
        film.add(k, TIMES_S[k], image(k), np.full((40, 60, 3), 0.5))
    for (kind, frame), data in film.pictures.items():
        atomic.write_bytes(folder / "film" / picture_name(kind, frame), data)
    place = {"extent_m": EXTENT_M, "crs": "EPSG:32618", "channel": "pan"}
    atomic.write_text(folder / "film" / "film.json", json.dumps(place | film.index()))
    return folder
