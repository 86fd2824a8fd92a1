"""Write a case from the figures of a data sheet: the file that ``glintrack case new`` makes."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from glintrack.case.design import Case
from glintrack.case.quantities import ground_view
from glintrack.core.designs import validate_design
from glintrack.core.schema import MIN_SCORED_S
from glintrack.sensor.catalogue import CatalogueItem, electrons_of, find_item
from glintrack.sensor.derivation import DEFAULT_F_NUMBER, derived_values

Polarizers = Literal["none", "superpixel", "2x2"]
CAMERA = {"polarizer": "constant", "polarizer_transmittance": 0.8, "polarizer_extinction_ratio": 300.0}
MOSAICS: dict[Polarizers, tuple[str, str, dict[str, Any]]] = {
    "none": ("pan", "no polarizers", {}),
    "superpixel": ("mirror-0-60-120", "the paper's micromirror and three wire grids", {}),
    "2x2": ("0-45-90-135", "four polarizer angles on the array", CAMERA),
}
OPTIONS = {
    "columns": "--pixels",
    "rows": "--pixels",
    "pitch_um": "--pitch",
    "focal_length_mm": "--focal-length",
}
RAY_SPACING_M = 0.25  # of the quickstart: 3 rays along an element of 0.75 m
_MIN_FRAMES, _MAX_FRAMES, _FLIGHT_S = 40, 100, 20.0
Entry = tuple[str, Any, str]  # key, value, comment


@dataclass(frozen=True)
class DataSheet:
    """Figures of a camera and of its flight, in the units of their names.

    Parameters
    ----------
    altitude_m, off_nadir_deg, rate_hz
        Height of the lens above the ground, angle of the line of sight from nadir, frame rate.
    columns, rows, pitch_um, focal_length_mm
        Array and lens; None for those of the catalogue.
    f_number, polarizers
        None for 5.6, and for those of the detector or none.
    detector, lens
        Names in the catalogue; may be empty.
    """

    altitude_m: float
    off_nadir_deg: float
    rate_hz: float
    columns: int | None = None
    rows: int | None = None
    pitch_um: float | None = None
    focal_length_mm: float | None = None
    f_number: float | None = None
    polarizers: Polarizers | None = None
    detector: str = ""
    lens: str = ""


def case_text(sheet: DataSheet, name: str) -> str:
    """Text of a commented case file of some name with what a data sheet states; the case derives the rest.

    Raises
    ------
    ValueError
        If a figure is missing, contradicts the catalogue or makes no valid case.
    """
    least = math.ceil(2 * MIN_SCORED_S * sheet.rate_hz) + 1
    frames = max(_MIN_FRAMES, min(round(_FLIGHT_S * sheet.rate_hz), _MAX_FRAMES), least)
    flight = [(key, getattr(sheet, key), "") for key in ("altitude_m", "off_nadir_deg", "rate_hz")]
    flight.append(
        ("frames", frames, f"{frames / sheet.rate_hz:.3g} s; add `speed_m_s` and `kind` of the path")
    )
    tables = {"": [], "flight": flight, "sensor": list(_sensor_entries(sheet))}
    if tables["sensor"][0][1] == "pan":
        tables[""].append(("channels", ["pan"], "without polarizers"))
    (across_m, along_m), (wide_m, high_m) = ground_view(_case_of(tables, name))
    rays = min(max(math.ceil(across_m / RAY_SPACING_M - 1e-6), 1), 5)
    tables["sensor"].append(("oversampling", rays, "rays along an element"))
    lines = [
        "# A case from a data sheet, made by `glintrack case new`. `glintrack case check` judges it.",
        f"# Ground: element {across_m:.3g} m × {along_m:.3g} m, field {wide_m:.0f} m × {high_m:.0f} m",
    ]
    for table, entries in tables.items():
        lines += ["", f"[{table}]"] if table else []
        lines += [f"{f'{k} = {json.dumps(v)}':<33} # {comment}".rstrip("# ") for k, v, comment in entries]
    lines += ["", "# Derived, as `glintrack case check` states; a key under [sensor] replaces its value:"]
    derived = derived_values(_case_of(tables, name).sensor)
    return "\n".join([*lines, *(f"# {value}" for value in derived), ""])


def _case_of(tables: dict[str, list[Entry]], name: str) -> Case:
    """Case with the values of all entries."""
    values = {table: {key: value for key, value, _ in entries} for table, entries in tables.items()}
    return validate_design(Case, {"name": name, **values.pop(""), **values})


def _sensor_entries(sheet: DataSheet) -> Iterator[Entry]:
    """Keys of ``[sensor]``, the layout first: from the options, else from the catalogue."""
    detector = find_item("detectors", sheet.detector) if sheet.detector else None
    lens = find_item("lenses", sheet.lens) if sheet.lens else None
    fixed = detector.figures.get("polarizers") if detector else None
    if fixed and sheet.polarizers not in (None, fixed):
        raise ValueError(f"`--polarizers` must be {fixed}, as on the detector array; got {sheet.polarizers}.")
    layout, text, polarizer = MOSAICS[fixed or sheet.polarizers or "none"]
    yield "layout", layout, text
    yield from ((key, value, "assumed") for key, value in polarizer.items())
    array = [_entry(sheet, key, detector) for key in ("columns", "rows", "pitch_um")]
    yield from array
    yield _entry(sheet, "focal_length_mm", lens)
    f_number = DEFAULT_F_NUMBER if sheet.f_number is None else sheet.f_number
    yield "f_number", f_number, "assumed" if sheet.f_number is None else ""
    columns, rows, pitch_um = (value for _, value, _ in array)
    if lens:
        _check_lens(lens, f_number, 1e-3 * pitch_um * math.hypot(columns, rows))
    yield "band_um", [0.4, 1.0], "assumed"
    yield "quantum_efficiency", "silicon", "assumed"
    yield "max_frame_rate_hz", sheet.rate_hz, "rate at which the array is read"
    if detector is None:
        return
    limit_hz = detector.figures.get("max_frame_rate_hz", sheet.rate_hz)
    if sheet.rate_hz > limit_hz:
        raise ValueError(f"`--rate` must be at most the array's {limit_hz:g} Hz; got {sheet.rate_hz:g}.")
    if "bits" in detector.figures:
        yield "bits", detector.figures["bits"], _source(detector, "bits")
    if pitch_um == detector.figures["pitch_um"]:
        figure = "snr_max_db" if "snr_max_db" in detector.figures else "full_well_e"
        for key, value in electrons_of(detector).items():
            yield key, value, _source(detector, figure)


def _entry(sheet: DataSheet, key: str, item: CatalogueItem | None) -> Entry:
    """Value of a data sheet, else of the catalogue."""
    if (value := getattr(sheet, key)) is not None:
        return key, value, ""
    if item is None:
        other = "--lens" if key == "focal_length_mm" else "--sensor"
        raise ValueError(f"`{OPTIONS[key]}` must be given where there is no {other}; got neither.")
    return key, item.figures[key], _source(item, key)


def _check_lens(lens: CatalogueItem, f_number: float, diagonal_mm: float) -> None:
    """Refuse an aperture that a lens has not, and an array larger than its image."""
    least, circle_mm = lens.figures["f_number"], lens.figures["image_circle_mm"]
    if f_number < least:
        raise ValueError(f"`--f-number` must be at least the lens's {least:g}; got {f_number:g}.")
    if diagonal_mm > circle_mm:
        raise ValueError(
            f"`--lens` must have an image circle of the array's {diagonal_mm:.3g} mm at least; "
            f"got {circle_mm:g} mm of {lens.name}."
        )


def _source(item: CatalogueItem, figure: str) -> str:
    """Name of the page of a figure, without its address."""
    return f"{item.title}: {item.sources[figure].split(', http')[0]}"
