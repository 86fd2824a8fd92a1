"""Hold `glintrack polarimetry` against polanalyser on raws of a Polarsens camera.

    python validation/polanalyser.py camera.png carps.png fruits.png polarizer.png

Raws to try it on lie in the history of the public repository elerac/polanalyser (MIT), folder ``images``.
Both programs demosaick bilinearly, ours to each superpixel's centre, theirs to every element, which are then
averaged over the superpixel. Prints the largest difference of S0 (theirs halved, by our convention) and of
DoLP and AoP. Superpixels that use a full element, and two rows and columns at the edge, which OpenCV fills
otherwise, are left out. PPID's own difference from bilinear stands beside it, for scale.
"""

import sys
from pathlib import Path

import numpy as np
import polanalyser

from glintrack.io.raw_mosaics import read_raw
from glintrack.sensor import RawDesign, measure_polarization

EDGE = 2  # superpixels
OTHERS = ("ppid", "eari")
ANGLES = np.radians([0, 45, 90, 135])


def theirs(counts):
    """Stokes vectors of polanalyser at the superpixels, S0 as a polarizer reads unpolarized light."""
    fine = counts.astype(np.uint16) * (256 if counts.dtype == np.uint8 else 1)  # OpenCV rounds to integers
    scale = 256.0 if counts.dtype == np.uint8 else 1.0
    images = [image.astype(float) / scale for image in polanalyser.demosaicing(fine)]
    stokes = polanalyser.calcLinearStokes(images, ANGLES)
    rows, columns = counts.shape
    return stokes.reshape(rows // 2, 2, columns // 2, 2, 3).mean(axis=(1, 3)) / 2


def compare(counts):
    """Largest differences of S0 [count], DoLP [1] and AoP [°], and RMS DoLP from bilinear to the others."""
    told = {
        method: measure_polarization(counts, RawDesign(demosaic=method, dark_noise=0, max_saturated=0.5))
        for method in ("bilinear", *OTHERS)
    }
    ours, reference = told["bilinear"], theirs(counts)
    known = np.isfinite(ours["dolp"].values)
    inside = np.zeros_like(known)
    inside[EDGE:-EDGE, EDGE:-EDGE] = True
    degree = polanalyser.cvtStokesToDoLP(reference)
    angle = polanalyser.cvtStokesToAoLP(reference)
    known &= inside & np.all([np.isfinite(told[method]["dolp"].values) for method in OTHERS], axis=0)
    s0 = np.abs(ours["stokes_radiance"].values[..., 0] - reference[..., 0])[known].max()
    dolp = np.abs(ours["dolp"].values - degree)[known].max()
    polarized = known & (degree > 0.02)
    turn = np.degrees(np.abs(np.angle(np.exp(2j * (ours["aop"].values - angle)))) / 2)[polarized].max()
    apart = [(told[method]["dolp"].values - ours["dolp"].values)[known] for method in OTHERS]
    return s0, dolp, turn, [float(np.sqrt(np.mean(one**2))) for one in apart], float(known.mean())


def main():
    """One row a raw."""
    print("| raw | S0 [count] | DoLP | AoP [°] | PPID, EARI from bilinear, RMS DoLP | superpixels compared |")
    print("| --- | --- | --- | --- | --- | --- |")
    for path in map(Path, sys.argv[1:]):
        s0, dolp, turn, apart, share = compare(read_raw(path))
        others = ", ".join(f"{one:.4f}" for one in apart)
        print(f"| {path.stem} | {s0:.1g} | {dolp:.1g} | {turn:.1g} | {others} | {share:.2f} |")


if __name__ == "__main__":
    main()
