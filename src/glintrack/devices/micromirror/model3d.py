"""The superpixel as a solid model: micromirror on its springs and electrodes, and wire-grid polarizers.

Like the paper's Figure 4b, in micrometres; heights, travel and tilt can be exaggerated.
"""

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from shapely import LineString, box

from glintrack.core.arrays import Array
from glintrack.core.installation import read_data
from glintrack.devices.micromirror.equilibrium import ELECTRODE_ANGLES_RAD, MicromirrorDesign
from glintrack.devices.wire_grid.design import WireGridDesign
from glintrack.io.gltf import Document

Part = tuple[Float[Array, "vertex 3"], Int[Array, "face 3"]]
_BOX_FACES = np.array(
    [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4)]
    + [(2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
)
_ROUND = 32  # corners of a disc
_SUBSTRATE, _METAL, _MIRROR, _ELECTRODE, _SPRING = range(5)


def superpixel_glb(
    design: MicromirrorDesign,
    plate: xr.Dataset,
    grid: WireGridDesign,
    pitch_um: float = 17.0,
    exaggeration: float = 1.0,
) -> bytes:
    """Micromirror and polarizers at 0°, 60° and 120° as a ``.glb`` file; one unit is a micrometre.

    Parameters
    ----------
    design, plate
        The mirror and its shape from `plate.bend_plate`.
    grid
        Wire grid of each polarizer.
    pitch_um
        Spacing of the elements; the mirror must fit it. [µm]
    exaggeration
        Factor on the plate's deflection. [1]
    """
    if pitch_um < max(design.plate.side_um, grid.aperture_um):
        raise ValueError(
            f"`pitch_um` must be at least the mirror's {design.plate.side_um:g} µm and the aperture's "
            f"{grid.aperture_um:g} µm; got {pitch_um:g}."
        )
    document = Document()
    for name, colour, metallic, rough in read_data("devices", "superpixel.toml")["materials"]:
        document.add_material(name, np.array(colour), metallic, rough)
    base = _box(0, 0, -1.0, 2 * pitch_um, 2 * pitch_um, 1.0)
    _add_node(document, "substrate", [(base, _SUBSTRATE)], 0.0, 0.0)
    # rows and columns of the superpixel as in `sensor.LAYOUTS`: mirror, 0°, 60°, 120° from the top left
    _add_node(document, "micromirror", _mirror(design, plate, exaggeration), -pitch_um / 2, pitch_um / 2)
    places = (0.0, pitch_um / 2, pitch_um / 2), (60.0, -pitch_um / 2, -pitch_um / 2)
    for angle, x, y in (*places, (120.0, pitch_um / 2, -pitch_um / 2)):
        _add_node(document, f"polarizer {angle:g}°", _polarizer(grid, np.radians(angle), pitch_um), x, y)
    return document.bytes()


def _add_node(document: Document, name: str, parts: list[tuple[Part, int]], x_um: float, y_um: float) -> None:
    vertices, faces, material, count = [], [], [], 0
    for (points, triangles), colour in parts:
        vertices.append(points)
        faces.append(triangles + count)
        material.append(np.full(len(triangles), colour))
        count += len(points)
    mesh = document.add_mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(material), name)
    document.add_node(name, mesh, np.column_stack([np.eye(3), [x_um, y_um, 0.0]]))


def _mirror(design: MicromirrorDesign, plate: xr.Dataset, exaggeration: float) -> list[tuple[Part, int]]:
    a = design.actuator
    thick = design.plate.thickness_nm * 1e-3
    sunk = -exaggeration * plate["deflection"].values * 1e6
    x, y = np.meshgrid(plate["x"].values * 1e6, plate["y"].values * 1e6)
    low = a.electrode_gap_um + sunk
    parts = [(_slab(x, y, low, low + 0.9 * thick), _METAL)]
    parts.append((_slab(x, y, low + 0.9 * thick, low + thick), _MIRROR))
    for angle in ELECTRODE_ANGLES_RAD:
        middle = a.electrode_radius_um * np.cos(angle), a.electrode_radius_um * np.sin(angle)
        radius = np.sqrt(a.electrode_area_um2 / np.pi)
        parts.append((_disc(*middle, -0.01, radius, 0.06), _ELECTRODE))
        foot = a.spring_radius_um * np.cos(angle), a.spring_radius_um * np.sin(angle)
        height = float(plate["deflection"].interp(x=foot[0] * 1e-6, y=foot[1] * 1e-6) * -1e6 * exaggeration)
        parts.append((_disc(*foot, 0.0, 0.25 * a.leg_radius_um, a.electrode_gap_um + height), _SPRING))
    return parts


def _polarizer(grid: WireGridDesign, angle_rad: float, pitch_um: float) -> list[tuple[Part, int]]:
    """Wires across the transmission axis at ``angle_rad``, clipped to a square aperture in its plate."""
    half, tall = grid.aperture_um / 2, grid.wire_height_nm * 1e-3
    outer = pitch_um / 2 * 0.98
    frame = outer - half
    parts = [
        (_box(x, y, 0.0, width, depth, tall), _METAL)
        for x, y, width, depth in (
            (0, half + frame / 2, 2 * outer, frame),
            (0, -half - frame / 2, 2 * outer, frame),
            (half + frame / 2, 0, frame, 2 * half),
            (-half - frame / 2, 0, frame, 2 * half),
        )
    ]
    across = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    along = np.array([-across[1], across[0]])
    reachable = half - grid.wire_width_nm * 5e-4
    square = box(-reachable, -reachable, reachable, reachable)
    reach = int(np.ceil(np.sqrt(2) * grid.aperture_um / grid.period_nm * 1e3 / 2)) + 1
    start = 0.5 * ((grid.wires + 1) % 2)
    for k in np.arange(-reach, reach + 1) + start:
        middle, far = k * grid.period_nm * 1e-3 * across, 2 * grid.aperture_um * along
        wire = LineString([middle - far, middle + far]).intersection(square)
        if wire.length > 1e-3:
            start, stop = np.array(wire.coords)
            points, faces = _box(0, 0, 0, wire.length, grid.wire_width_nm * 1e-3, tall)
            turn = np.array([[along[0], along[1], 0], [-along[1], along[0], 0], [0, 0, 1]])
            parts.append(((points @ turn + [*((start + stop) / 2), 0.0], faces), _METAL))
    return parts


def _box(x: float, y: float, z: float, width: float, depth: float, height: float) -> Part:
    """Box centred in x and y, with its base at z."""
    corners = [(i, j, k) for k in (0, 1) for j in (-0.5, 0.5) for i in (-0.5, 0.5)]
    return np.array([x, y, z]) + np.array(corners) * [width, depth, height], _BOX_FACES


def _disc(x: float, y: float, z: float, radius: float, height: float) -> Part:
    """Upright cylinder."""
    angle = 2 * np.pi * np.arange(_ROUND) / _ROUND
    ring = np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)])
    low, high = (np.column_stack([ring, np.full(_ROUND, level)]) for level in (z, z + height))
    points = np.concatenate([low, high, [[x, y, z], [x, y, z + height]]])
    i, j = np.arange(_ROUND), (np.arange(_ROUND) + 1) % _ROUND
    n, bottom, top = _ROUND, np.full(_ROUND, 2 * _ROUND), np.full(_ROUND, 2 * _ROUND + 1)
    sides = [np.column_stack(c) for c in ((i, j, j + n), (i, j + n, i + n))]
    return points, np.concatenate(
        [*sides, np.column_stack([top, i + n, j + n]), np.column_stack([bottom, j, i])]
    )


def _slab(x: Array, y: Array, low: Array, high: Array) -> Part:
    """Curved sheet over a grid, with its rim."""
    rows, columns = x.shape
    points = np.concatenate([np.stack([x, y, z], axis=-1).reshape(-1, 3) for z in (low, high)])
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    top = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    n = rows * columns
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    following = np.roll(rim, -1)
    sides = [np.column_stack(t) for t in ((rim, following, following + n), (rim, following + n, rim + n))]
    return points, np.concatenate([top[:, ::-1], top + n, *sides])
