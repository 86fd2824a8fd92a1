"""The superpixel as a 3-D file: it opens, is closed, and is as large as designed."""

import numpy as np
import pytest
import xarray as xr

from glintrack.devices.micromirror.equilibrium import MicromirrorDesign
from glintrack.devices.micromirror.model3d import superpixel_glb
from glintrack.devices.wire_grid.design import WireGridDesign

FLOAT32 = 1e-5  # of micrometres in single precision


def flat(side_um=16.0, sunk_m=0.0):
    line = np.linspace(-side_um / 2, side_um / 2, 5) * 1e-6
    values = np.full((5, 5), sunk_m)
    return xr.Dataset({"deflection": (("y", "x"), values)}, coords={"y": line, "x": line})


def opened(data, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "superpixel.glb"
    path.write_bytes(data)
    return trimesh.load(path)


def test_parts_are_closed_and_of_the_designed_volume(tmp_path):
    scene = opened(superpixel_glb(MicromirrorDesign(), flat(), WireGridDesign()), tmp_path)
    assert all(mesh.is_watertight and mesh.volume > 0 for mesh in scene.geometry.values())
    mirror = sorted(mesh.volume for name, mesh in scene.geometry.items() if name.startswith("micromirror"))
    assert mirror[-1] + mirror[-2] == pytest.approx(16 * 16 * 0.5, rel=FLOAT32)
    wires = scene.geometry["polarizer 0°"].volume
    frame = ((17 * 0.98) ** 2 - 100) * 0.1
    assert wires - frame == pytest.approx(20 * 0.1 * 0.1 * 10, rel=0.02)  # wires end half a width early


def test_deflection_sinks_the_plate_as_exaggerated(tmp_path):
    design, grid = MicromirrorDesign(), WireGridDesign()
    high = opened(superpixel_glb(design, flat(), grid), tmp_path).bounds[1, 1]
    low = opened(superpixel_glb(design, flat(sunk_m=100e-9), grid, exaggeration=3), tmp_path).bounds[1, 1]
    assert high == pytest.approx(2.0, rel=FLOAT32)  # gap and plate; y is up in the file
    assert high - low == pytest.approx(0.3, rel=1e-4)


def test_a_pitch_too_small_is_refused():
    with pytest.raises(ValueError, match="`pitch_um` must be at least the mirror's 16 µm"):
        superpixel_glb(MicromirrorDesign(), flat(), WireGridDesign(), pitch_um=12)
