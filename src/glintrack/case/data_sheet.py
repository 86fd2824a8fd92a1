"""Write a case from the figures of a data sheet: the file that ``glintrack case new`` makes."""

import json
import math
from collections.abc import Mapping
from typing import Any, Literal

from glintrack.atmosphere import sun_direction
from glintrack.case.design import Case
from glintrack.case.quantities import ground_view
from glintrack.core.designs import validate_design
from glintrack.core.schema import MIN_SCORED_S
from glintrack.scene.design import SHIPPED_DURATION_S
from glintrack.sensor.catalogue import find_item
from glintrack.sensor.derivation import DEFAULT_F_NUMBER, derived_values
from glintrack.sensor.layouts import filter_band, places, superpixel

Polarizers = Literal["none", "superpixel", "2x2"]
MOSAICS: dict[Polarizers, tuple[str, str]] = {
    "none": ("pan", "no polarizers"),
    "superpixel": ("mirror-0-60-120", "the paper's micromirror and three wire grids"),
    "2x2": ("0-45-90-135", "four polarizer angles on the array"),
}
Filters = Literal["rgb", "four-bands"]
CAMERA = {"polarizer": "constant", "polarizer_transmittance": 0.8, "polarizer_extinction_ratio": 300.0}
OPTIONS = {  # that give a key of [sensor], and that name an item of the catalogue with it
    **dict.fromkeys(("columns", "rows"), ("--pixels", "--sensor")),
    "pitch_um": ("--pitch", "--sensor"),
    "focal_length_mm": ("--focal-length", "--lens"),
}
RAY_SPACING_M = 0.25  # of the quickstart: 3 rays along an element of 0.75 m
_MIN_FRAMES, _MAX_FRAMES, _FLIGHT_S = 40, 100, 20.0
USUAL_FIELD_DEG, USUAL_GSD_M = 50.0, (0.01, 2.0)  # beyond them a unit may be wrong
Entries = dict[str, tuple[Any, str]]  # value and comment of a key


def case_text(
    name: str,
    flight: Mapping[str, float],
    camera: Mapping[str, Any],
    polarizers: Polarizers | None = None,
    detector: str = "",
    lens: str = "",
    filters: Filters | None = None,
) -> str:
    """Text of a commented case file with what a data sheet states; the case derives the rest.

    Parameters
    ----------
    name
        Name of the case.
    flight
        ``altitude_m``, ``off_nadir_deg`` and ``rate_hz`` of ``[flight]``.
    camera
        Array, focal length and F-number as keys of ``[sensor]``; None for those of the catalogue, or F/5.6.
    polarizers
        Mosaic on the array; None for that of the detector, or none.
    detector, lens
        Names in the catalogue; may be empty.
    filters
        Mosaic of colour filters on the array, instead of polarizers.

    Raises
    ------
    ValueError
        If a figure is missing, contradicts the catalogue or makes no valid case.
    """
    rate_hz = flight["rate_hz"]
    least = math.ceil(2 * MIN_SCORED_S * rate_hz) + 1
    most = int(SHIPPED_DURATION_S * rate_hz) + 1  # as long as there is traffic
    frames = min(max(_MIN_FRAMES, min(round(_FLIGHT_S * rate_hz), _MAX_FRAMES), least), most)
    path: Entries = {key: (value, "") for key, value in flight.items()}
    path["frames"] = frames, f"{frames / rate_hz:.3g} s"
    sensor = _array_entries(polarizers, detector, rate_hz, filters)
    _add_figures(sensor, camera, lens)
    polarized = places(superpixel(sensor["layout"][0]), "polarizer")
    top: Entries = {} if polarized else {"channels": (["pan"], "without polarizers")}
    tables = {"": top, "flight": path, "sensor": sensor}
    drawn = _case_of(tables, name)
    (across_m, along_m), (wide_m, high_m) = ground_view(drawn)
    field_deg, focal_mm = max(drawn.sensor.field_of_view_deg), drawn.sensor.focal_length_mm
    rays = min(max(math.ceil(across_m / RAY_SPACING_M - 1e-6), 1), 5)
    sensor["oversampling"] = rays, f"rays along an element, at most {RAY_SPACING_M:g} m apart on the ground"
    lines = [
        "# A case from a data sheet, made by `glintrack case new`. `glintrack case check` judges it.",
        f"# Ground: element {across_m:.3g} m × {along_m:.3g} m, field {wide_m:.0f} m × {high_m:.0f} m",
    ]
    if field_deg > USUAL_FIELD_DEG or not USUAL_GSD_M[0] < across_m < USUAL_GSD_M[1]:
        lines.append(
            f"# Check the units: a field of view of {field_deg:.0f}° or elements that see {across_m:.2g} m "
            f"are unusual. Altitude {flight['altitude_m']:g} is in m, focal length {focal_mm:g} in mm"
        )
    for table, entries in tables.items():
        lines += ["", f"[{table}]"] if table else []
        lines += [f"{f'{k} = {json.dumps(v)}':<33} # {why}".rstrip("# ") for k, (v, why) in entries.items()]
    case = _case_of(tables, name)
    lines += ["", "# Assumed, with the keys that change it:", *(f"# {one}" for one in assumptions(case))]
    lines += ["", "# Derived; a key under [sensor] replaces its value:"]
    return "\n".join([*lines, *(f"# {line}" for line in derived_values(case.sensor).values()), ""])


def assumptions(case: Case) -> list[str]:
    """Describe what a case assumes about place, time, view, traffic and light, with the keys for it."""
    air, flight, sensor = case.atmosphere, case.flight, case.sensor
    zenith_deg, sun_deg = map(math.degrees, sun_direction(air))
    toward_deg, (first, last) = (sun_deg + flight.azimuth_from_sun_deg) % 360, sensor.band_um
    circle = f"from a circle at {flight.speed_m_s:g} m/s, first toward azimuth {toward_deg:.0f}°"
    aside = f"{circle}, {flight.azimuth_from_sun_deg:g}° from that of the sun"
    polarizers = sensor.polarizer if sensor.has_stokes else "none"
    found = (
        (f"place: latitude {air.latitude_deg:g}°, longitude {air.longitude_deg:g}°",
         "atmosphere.latitude_deg", "atmosphere.longitude_deg"),
        (f"time: {air.date} at {air.local_time_h:g} h standard time, sun {90 - zenith_deg:.0f}° high",
         "atmosphere.date", "atmosphere.local_time_h"),
        (f"air: {air.aerosol} aerosol, clouds of optical depth {air.cloud_optical_depth:g}",
         "atmosphere.aerosol", "atmosphere.visibility_km", "atmosphere.cloud_optical_depth"),
        (f"view: {aside if flight.off_nadir_deg else 'straight down, from one place'}",
         "flight.kind", "flight.speed_m_s", "flight.azimuth_from_sun_deg"),
        (f"traffic: cars and trucks of the city {case.scene.city!r}", "scene.city", "scene.traffic_file"),
        (f"light: {first:g} to {last:g} µm, quantum efficiency {sensor.quantum_efficiency}",
         "sensor.band_um", "sensor.quantum_efficiency"),
        (f"polarizers: {polarizers}, mosaic {sensor.layout}", "sensor.polarizer", "sensor.layout"),
        ("errors of pose and pixels: none", "navigation.preset", "flight.jitter_rms_urad", "sensor.prnu",
         "sensor.dark_current_e_per_s"),
    )  # fmt: skip
    return [f"{text} (`{'`, `'.join(keys)}`)" for text, *keys in found]


def _case_of(tables: Mapping[str, Entries], name: str) -> Case:
    """Case with the values of all entries."""
    values = {table: {key: value for key, (value, _) in entries.items()} for table, entries in tables.items()}
    return validate_design(Case, {"name": name, **values.pop(""), **values})


def _array_entries(
    polarizers: Polarizers | None, detector: str, rate_hz: float, filters: Filters | None
) -> Entries:
    """Mosaic, band and quantum efficiency, and the figures of a detector array."""
    entries: Entries = {"band_um": ([0.4, 1.0], "assumed"), "quantum_efficiency": ("silicon", "assumed")}
    item = find_item("detectors", detector) if detector else None
    if item:
        entries |= {key: (value, item.source(key)) for key, value in item.figures.items()}
        limit_hz = item.figures.get("max_frame_rate_hz", math.inf)
        if rate_hz > limit_hz:
            raise ValueError(f"`--rate` must be at most the array's {limit_hz:g} Hz; got {rate_hz:g}.")
    entries["max_frame_rate_hz"] = rate_hz, "rate at which the array is read"
    if polarizers or not item:
        if item and item.figures["layout"] not in ("pan", MOSAICS[polarizers or "none"][0]):
            raise ValueError(f"`--polarizers` must be left out: {detector} has its own; got {polarizers}.")
        entries["layout"] = MOSAICS[polarizers or "none"]
    if filters:
        if entries["layout"][0] != "pan":
            raise ValueError(
                f"`--filters` must be left out with polarizers on the array; got {filters} and mosaic "
                f"{entries['layout'][0]}."
            )
        entries["layout"] = filters, "colour filters, with ideal edges"
        bands = [filter_band(what) for row in superpixel(filters) for what in row]
        ends_um = [um for band in bands if band for um in band]
        entries["band_um"] = [min(ends_um), max(ends_um)], "from the first filter to the last"
    if polarizers == "2x2":
        entries |= {key: (value, "assumed") for key, value in CAMERA.items()}
    return entries


def _add_figures(entries: Entries, camera: Mapping[str, Any], lens: str) -> None:
    """Add array and optics: figures of the camera, else of the lens, else F/5.6."""
    item = find_item("lenses", lens) if lens else None
    if item:
        entries["focal_length_mm"] = item.figures["focal_length_mm"], item.source("focal_length_mm")
    for key, (option, other) in OPTIONS.items():
        if (value := camera.get(key)) is not None and key in entries:
            raise ValueError(f"`{other}` must be given without {option}; got both. Leave one out.")
        if value is None and key not in entries:
            raise ValueError(
                f"`{option}` must be given, or {other} with a name of `glintrack sensor list`; got neither."
            )
        entries.setdefault(key, (value, ""))
    f_number = camera.get("f_number")
    entries["f_number"] = (DEFAULT_F_NUMBER, "assumed") if f_number is None else (f_number, "")
    f_number, columns, rows, pitch_um = (entries[k][0] for k in ("f_number", "columns", "rows", "pitch_um"))
    diagonal_mm = 1e-3 * pitch_um * math.hypot(columns, rows)
    if item and f_number < (least := item.figures["f_number"]):
        raise ValueError(f"`--f-number` must be at least the lens's {least:g}; got {f_number:g}.")
    if item and diagonal_mm > (circle_mm := item.figures["image_circle_mm"]):
        raise ValueError(
            f"`--lens` must have an image circle of the array's {diagonal_mm:.3g} mm at least; "
            f"got {circle_mm:g} mm of {lens}."
        )
