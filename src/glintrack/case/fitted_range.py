"""Rules and models of the tracker that a case uses, and the range in which they were fitted.

The ranges are in ``data/calibration``. A quantity outside them is doubtful.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from glintrack.case.design import Case
from glintrack.case.quantities import ground_view, off_nadir_deg
from glintrack.core.units import format_number
from glintrack.track.calibration import read_calibration
from glintrack.track.detect.binning import binning_factor

# a calibration holds for that much more or less than it was fitted at: a share, or an angle
_MARGIN, _MARGIN_DEG = 0.25, 10.0
OPPOSITE = {"+": "-", "-": "+"}  # to raise or to lower a key


def describe_initiation(case: Case) -> str:
    """Line with the rules of confirmation and coasting that are in use, for detections with ratios."""
    initiation = case.track.effective(True).initiation
    rules = initiation.in_use
    least = (
        (f"over {rules.confirm_min_age_s:g} s or more", rules.confirm_min_age_s),
        (f"over {rules.confirm_travel_m:g} m or more", rules.confirm_travel_m),
        (f"at {rules.confirm_speed_m_s:g} m/s or more", rules.confirm_speed_m_s),
    )
    hits = f"detections in {rules.confirm_hits} of {rules.confirm_window} frames"
    return (
        f"tracker: a track is confirmed by {', '.join([hits, *(text for text, value in least if value)])} "
        f"(rules {initiation.rules!r}, `track.reporting.method` = {case.track.reporting.method!r}). "
        f"Without detections it ends after {initiation.coast_s:g} s, that of a stopped vehicle after "
        f"{rules.stopped_coast_s:g} s"
    )


def describe_array(case: Case) -> str:
    """Line on the elements of the array, their polarizers, and the channels that are tracked."""
    sensor = case.sensor
    layout = sensor.layout if isinstance(sensor.layout, str) else "given elements"
    polarizers = f"polarizers {sensor.polarizer!r}" if sensor.has_stokes else "no polarizers"
    mirror = ", a micromirror in each superpixel" if sensor.has_mirror else ""
    fitted = read_calibration("mosaic").valid["layout"]
    other = "" if layout == fitted else f". Detector and tracker were fitted to {fitted!r} alone"
    channels = ", ".join(case.channels)
    return f"array: mosaic {layout!r}, {polarizers}{mirror}{other}. Tracked channels: {channels}"


def detector_binning(case: Case) -> int:
    """Elements along one that the detector sees. [1]"""
    is_fine = case.track.detect.detector != "median-motion"
    return binning_factor(ground_view(case)[0][0]) if is_fine else 1


def describe_binning(case: Case) -> list[str]:
    """Line on the elements that the detector averages, if they are finer than its fitted range."""
    factor = detector_binning(case)
    gsd_m = factor * ground_view(case)[0][0]
    line = f"detector: means of {factor} × {factor} elements of a kind, with a ground sample distance of "
    return [f"{line}{format_number(gsd_m)} m"] if factor > 1 else []


class FittedQuantity(NamedTuple):
    """Value of a quantity in a case, the range that all models were fitted in, and the good range."""

    value: float
    fitted: tuple[float, float]
    good: tuple[float, float]


def fitted_quantities(case: Case) -> dict[str, FittedQuantity]:
    """Quantities of a case for which detector and tracker have a fitted range, by name."""
    design = case.track.effective(True)
    detector = design.detect.detector.replace("auto", "mosaic")  # which it is in a case
    names = [detector.replace("-", "_")]
    if design.reporting.uses_existence:
        names += ["existence", "existence_smoothed"]
    ranges: list[Mapping[str, Any]] = [
        read_calibration(name).valid_range(channel) for name in names for channel in case.channels
    ]
    if design.initiation.flow_velocity:
        ranges.append(read_calibration("flow").valid)
    ranges.append(read_calibration("initiation").valid_range(design.initiation.rules))
    values = {"rate_hz": case.flight.rate_hz, "max_speed_m_s": design.detect.max_speed_m_s}
    if design.reporting.effective_lag_s:
        values["lag_s"] = design.reporting.lag_s
    if case.flight.kind != "waypoints":
        values["gsd_m"] = detector_binning(case) * ground_view(case)[0][0]
        values["off_nadir_deg"] = off_nadir_deg(case)
    found = {}
    for name, value in values.items():
        if fitted := [of[name] for of in ranges if name in of]:
            low, high = max(map(min, fitted)), min(map(max, fitted))
            good = (low / (1 + _MARGIN), high / (1 - _MARGIN))
            if name == "off_nadir_deg":
                good = (low - _MARGIN_DEG, high + _MARGIN_DEG)
            found[f"fitted_{name}"] = FittedQuantity(value, (min(low, high), max(low, high)), good)
    if detectors := [of["detector"] == detector for of in ranges if "detector" in of]:
        share = sum(detectors) / len(detectors)
        found["fitted_detector"] = FittedQuantity(share, (1.0, 1.0), (1.0, math.inf))
    return found
