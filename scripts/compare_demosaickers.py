"""Compare demosaickers where the full-resolution truth is known: RMS errors of S0, DoLP and AoP.

    python scripts/compare_demosaickers.py [FOLDER] [--case CASE …] [--frame 0]

FOLDER is a user's copy of the public Polarimetric & Spectral Database (Lapray, Gendre, Foulonneau and Bigué,
Proc. SPIE 10677, 1067738 (2018); github.com/pjlapray/Polarimetric_Spectral_Database): scenes with four
aligned pictures each, ``SCENE/Raw/NIR_filtre_nir_{0,45,90,135}_aligned.tif``. Nothing of it is part of this
repository. Without FOLDER only the rows of our own light are printed: one frame of each case on the elements
behind its lens, everywhere and on vehicles, by the same mosaic without noise, and as the case flies it: its
superpixel, its polarizers, its noise.

Four pictures of one angle each are mosaicked again, 0-45-90-135, demosaicked, and held against the four
pictures' own Stokes vectors at each superpixel's centre, the mean of its four elements. S0 is relative to the
mean; AoP is compared where DoLP is above 0.05.
"""

import argparse
from pathlib import Path

import numpy as np

from glintrack import Case, label_frame
from glintrack.case.build import trace_frame
from glintrack.case.packaged import find_case
from glintrack.io.raw_mosaics import read_raw
from glintrack.sensor import build_sensor, demosaic, detector_readout, light_on_elements
from glintrack.sensor.layouts import LAYOUTS, analyser_matrix, invert, places
from glintrack.stokes import aop, dolp

LAYOUT = LAYOUTS["0-45-90-135"]
INVERSE = invert(analyser_matrix(LAYOUT, 1.0))
METHODS = ("superpixel", "bilinear", "ppid", "eari")  # the first is nearest: each kind as it lies
EDGE = 2  # superpixels
DARK = 0.02  # of the mean of S0: darker superpixels are left out
POLARIZED = 0.05  # DoLP above which an angle is compared


def from_angles(pictures):
    """Stokes vectors (y, x, 3) of pictures behind polarizers, by angle [°]; unpolarized light reads as S0."""
    i0, i45, i90, i135 = (np.asarray(pictures[angle], float) for angle in (0, 45, 90, 135))
    return np.stack([(i0 + i45 + i90 + i135) / 4, (i0 - i90) / 2, (i45 - i135) / 2], axis=-1)


def mosaicked(stokes):
    """What the elements of the mosaic read of full-resolution light."""
    out = np.empty(stokes.shape[:2])
    for (i, j), row in zip(places(LAYOUT, "polarizer"), analyser_matrix(LAYOUT, 1.0), strict=True):
        out[i::2, j::2] = stokes[i::2, j::2] @ row
    return out


def of_superpixels(values):
    """Means over 2 × 2 elements, and what a row or column too many holds left out."""
    rows, columns = (n // 2 * 2 for n in values.shape[:2])
    values = values[:rows, :columns]
    return values.reshape(rows // 2, 2, columns // 2, 2, -1).mean(axis=(1, 3))


def errors(mosaic, wanted, layout=LAYOUT, inverse=INVERSE, where=None):
    """Method -> RMS error of S0 over its mean [1], of DoLP [1], of AoP [°]; on some superpixels or on all."""
    inner = np.s_[EDGE:-EDGE, EDGE:-EDGE]
    wanted = wanted[inner]
    used = wanted[..., 0] > DARK * wanted[..., 0].mean()
    if where is not None:
        used &= where[inner]
    polarized = used & (dolp(wanted) > POLARIZED)
    found = {}
    for method in METHODS:
        seen = (demosaic(mosaic, layout, method) @ inverse.T)[inner]
        turn = np.degrees(np.angle(np.exp(2j * (aop(seen) - aop(wanted)))) / 2)
        found[method] = (
            _rms((seen - wanted)[..., 0][used]) / wanted[..., 0][used].mean(),
            _rms((dolp(seen) - dolp(wanted))[used]),
            _rms(turn[polarized]) if polarized.any() else np.nan,
        )
    return found


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def database_scenes(folder):
    """Scene -> Stokes vectors of its near-infrared pictures."""
    scenes = {}
    for raw in sorted(folder.glob("*/Raw")):
        files = {a: raw / f"NIR_filtre_nir_{a}_aligned.tif" for a in (0, 45, 90, 135)}
        if all(path.is_file() for path in files.values()):
            scenes[raw.parent.name] = from_angles({angle: read_raw(path) for angle, path in files.items()})
    if not scenes:
        raise ValueError(f"`FOLDER` must hold SCENE/Raw/NIR_filtre_nir_0_aligned.tif and so on, got {folder}")
    return scenes


def own_rows(name, frame):
    """Rows of a frame of a case: its light behind the lens, and as its sensor reads that, noise and all."""
    case = Case.from_toml(find_case(name))
    view, shown = trace_frame(case, frame), label_frame(case, frame)["mask"].values >= 0
    vehicles = of_superpixels(shown)[..., 0] > 0
    ideal, flown = (
        build_sensor(one.sensor, view.sky.wavelength_um)
        for one in (case.replace({"sensor.polarizer": "ideal"}), case)
    )
    if ideal.planes != ((0, 0), (0, 1), (0, 2)):
        raise ValueError(f"`case` must have a layout with polarizers, got {case.sensor.layout}")
    light = np.moveaxis(light_on_elements(view.radiance(ideal.channels).values, ideal), 0, -1).astype(float)
    wanted, mosaic = of_superpixels(light), mosaicked(light)
    read = detector_readout(view.radiance(flown.channels).values, flown, np.random.default_rng(case.seed))
    own = {"layout": case.sensor.superpixel, "inverse": flown.stokes_matrix}
    for where, of in ((None, f"frame {frame}"), (vehicles, "its vehicles")):
        yield f"{name}, {of}", errors(mosaic, wanted, where=where)
        yield f"{name} as flown, {of}", errors(read, wanted, **own, where=where)


def main():
    """Print one row a scene."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", nargs="?", type=Path)
    options.add_argument("--case", nargs="*", default=["quickstart", "braunschweig"])
    options.add_argument("--frame", type=int, default=0)
    given = options.parse_args()
    print("| scene | " + " | ".join(f"{m}: S0, DoLP, AoP [°]" for m in METHODS) + " |")
    print("| --- |" + " --- |" * len(METHODS))
    for name, stokes in {} if given.folder is None else database_scenes(given.folder).items():
        _tell(name, errors(mosaicked(stokes), of_superpixels(stokes)))
    for case in given.case:
        for name, found in own_rows(case, given.frame):
            _tell(name, found)


def _tell(name, found):
    told = [f"{s0:.4f}, {degree:.4f}, {angle:.1f}" for s0, degree, angle in found.values()]
    print(f"| {name} | {' | '.join(told)} |", flush=True)


if __name__ == "__main__":
    main()
