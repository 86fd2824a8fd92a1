"""A lens prescription in the frame: its rays' wavefront, distortion and vignetting over the array."""

import math

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.distortion import Distortion
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.lens.prescription import LensDesign, image_of, path_errors_um, read_lens
from glintrack.sensor.lens_kernels import FIELD_NODES

_F_NUMBER_ERROR = 0.05  # between the design's and the prescription's, on the image's side
_TILT = 3  # Noll's indices to here are piston and tilts: distortion has them
_LEAST_NM = 0.05  # of a coefficient; 1/10000 of a wave changes no picture


def with_lens(design: SensorDesign) -> SensorDesign:
    """The design with its prescription's aberrations, distortion and vignetting worked out.

    Parameters
    ----------
    design
        With ``optics.lens`` or without; without it comes back as it is.

    Returns
    -------
    The same with ``field_zernikes_rms_nm``, ``distortion`` and ``vignetting`` of ``optics`` set and ``lens``
    empty.

    Raises
    ------
    ValueError
        If the extra ``optics`` is missing, or the prescription is none, does not reach the array's corners
        or has another F-number.

    Notes
    -----
    The middle of the prescription's fields images to the middle of the array; the image's x is to the right
    and its y up. Rays are those of the middle of the band, for all wavelengths. The design's focal length
    and principal point stand for the scale down the image and the shift that fit best; another scale across
    and Brown's polynomials for what is left.
    """
    optics = design.optics
    if not optics.lens:
        return design
    lens = read_lens(optics.lens)
    wavelength_um = sum(design.band_um) / 2
    objects, magnification = _objects(design, lens, wavelength_um)
    found = abs(magnification) * lens.f_number
    if abs(found / design.f_number - 1) > _F_NUMBER_ERROR:
        raise ValueError(
            f"`sensor.f_number` must be the lens's, {found:.2f} on the image's side of {lens.name}, "
            f"got {design.f_number:g}"
        )
    places, passed = image_of(lens, objects.reshape(-1, 2), wavelength_um)
    if not np.isfinite(places).all():
        raise ValueError(
            f"`sensor.optics.lens` must image the whole array, got no light in a part by {lens.name}"
        )
    errors_nm = 1e3 * path_errors_um(lens, objects.reshape(-1, 2), wavelength_um)
    # prescriptions count the path's error the other way round
    nodes = [
        {k: round(-float(v), 3) for k, v in enumerate(node, 1) if k > _TILT and abs(v) >= _LEAST_NM}
        for node in errors_nm
    ]
    zernikes = tuple(tuple(nodes[k : k + FIELD_NODES]) for k in range(0, len(nodes), FIELD_NODES))
    update = {
        "lens": "",
        "field_zernikes_rms_nm": zernikes,
        "distortion": _distortion(objects.reshape(-1, 2) * magnification, places, design.focal_length_mm),
        "vignetting": _vignetting(passed.reshape(objects.shape[:2]), design),
    }
    return design.model_copy(update={"optics": optics.model_copy(update=update)})


def _objects(
    design: SensorDesign, lens: LensDesign, wavelength_um: float
) -> tuple[Float[Array, "row column 2"], float]:
    """Places on the object, from the top left, that nodes over the array see; and the magnification. [mm]"""
    fields = np.array(lens.fields_mm)
    low, high = fields.min(axis=0), fields.max(axis=0)
    low[0], high[0] = min(low[0], -high[0]), max(high[0], -low[0])  # a prescription is even in x
    middle, step = (low + high) / 2, 1e-3 * max(np.ptp(fields), 1.0)
    near, _ = image_of(lens, middle + np.array([[-step, 0], [step, 0], [0, -step], [0, step]]), wavelength_um)
    magnification = float((near[1, 0] - near[0, 0] + near[3, 1] - near[2, 1]) / (4 * step))
    half = np.array([design.columns, design.rows]) / 2 * design.pitch_um * 1e-3
    reach = half / abs(magnification)
    allowed = (high - low) / 2 * 1.01
    if (reach > allowed).any():
        width, height = 2 * allowed * abs(magnification)
        raise ValueError(
            f"`sensor.optics.lens` must reach the array's corners, got {lens.name} for {width:.1f} × "
            f"{height:.1f} mm and an array of {2 * half[0]:.1f} × {2 * half[1]:.1f} mm"
        )
    nodes = np.linspace(-1, 1, FIELD_NODES)
    right, up = np.meshgrid(nodes * half[0], -nodes * half[1])
    return middle + np.stack([right, up], axis=-1) / magnification, magnification


def _distortion(ideal_mm: Array, image_mm: Array, focal_mm: float) -> Distortion:
    """Coefficients that fit the images best, beside a shift and a scale of their own."""
    x, y = ((ideal_mm - ideal_mm.mean(axis=0)) / focal_mm).T
    moved = (image_mm - image_mm.mean(axis=0)) / focal_mm - np.stack([x, y], axis=-1)
    y, moved_y = -y, -moved[:, 1]  # down
    r2 = x * x + y * y
    one, none = np.ones_like(x), np.zeros_like(x)
    across = [x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x, y, x, one, none]
    down = [y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, none, none, y, none, one]
    columns = np.concatenate([np.stack(across, axis=-1), np.stack(down, axis=-1)])
    scale = np.linalg.norm(columns, axis=0)
    fitted = np.linalg.lstsq(columns / scale, np.concatenate([moved[:, 0], moved_y]), rcond=None)[0] / scale
    k1, k2, p1, p2, b1, b2 = (float(v) for v in fitted[:6])
    return Distortion(k1=k1, k2=k2, p1=p1, p2=p2, b1=b1, b2=b2)


def _vignetting(passed: Array, design: SensorDesign) -> float:
    """Light lost in the corner beside the middle, as the square of the distance that fits best."""
    down, right = np.meshgrid(
        *(np.linspace(-n, n, FIELD_NODES) for n in (design.rows, design.columns)), indexing="ij"
    )
    height2 = (down**2 + right**2) / math.hypot(design.rows, design.columns) ** 2
    middle = float(passed[FIELD_NODES // 2, FIELD_NODES // 2])
    lost = 1 - passed / middle
    return float(np.clip((lost * height2).sum() / (height2**2).sum(), 0, 0.99))
