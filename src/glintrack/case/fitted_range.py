"""Rules and models of the tracker that a case uses, and the range in which they were fitted.

The ranges are in ``data/calibration``. A case outside them runs, with a warning.
"""

from glintrack.case.design import Case
from glintrack.case.quantities import ground_view
from glintrack.core.units import format_number
from glintrack.track.calibration import read_calibration
from glintrack.track.detect.binning import binning_factor

# a calibration holds for that much more or less than it was fitted at: a share, or an angle
_MARGIN, _MARGIN_DEG = 0.25, 10.0


def describe_initiation(case: Case) -> str:
    """Line with the rules of confirmation and coasting that are in use, for detections with ratios."""
    initiation = case.track.effective(True).initiation
    rules = initiation.in_use
    return (
        f"confirmation: {rules.confirm_hits} of {rules.confirm_window} frames, "
        f"{rules.confirm_min_age_s:g} s, {rules.confirm_travel_m:g} m, {rules.confirm_speed_m_s:g} m/s "
        f"(rules {initiation.rules!r}); coasting {initiation.coast_s:g} s, "
        f"stopped {rules.stopped_coast_s:g} s"
    )


def detector_binning(case: Case) -> tuple[int, float]:
    """Elements along one that the detector sees, and the ground sample distance of that. [1, m]"""
    gsd_m = ground_view(case)[0][0]
    factor = 1 if case.track.detect.detector == "median-motion" else binning_factor(gsd_m)
    return factor, factor * gsd_m


def describe_binning(case: Case) -> list[str]:
    """Line on the elements that the detector averages, if they are finer than its fitted range."""
    factor, gsd_m = detector_binning(case)
    if factor == 1:
        return []
    return [
        f"detector: means of {factor} × {factor} elements of a kind, with a ground sample distance of "
        f"{format_number(gsd_m)} m"
    ]


def tracker_notes(case: Case) -> list[str]:
    """Sentence on what is outside the range in which models of detector and tracker were fitted, if any."""
    design = case.track.effective(True)
    detector = design.detect.detector.replace("auto", "mosaic")  # which it is in a case
    ranges = [read_calibration(detector.replace("-", "_")).valid]
    if design.reporting.uses_existence:
        ranges += [read_calibration(name).valid for name in ("existence", "existence_smoothed")]
    if design.initiation.flow_velocity:
        ranges.append(read_calibration("flow").valid)
    ranges += [read_calibration("initiation").valid[design.initiation.rules]]
    values = {
        "rate_hz": ("frame rate", case.flight.rate_hz, " Hz"),
        "max_speed_m_s": ("`track.detect.max_speed_m_s`", design.detect.max_speed_m_s, " m/s"),
    }
    if design.reporting.effective_lag_s:
        values["lag_s"] = ("`track.reporting.lag_s`", design.reporting.lag_s, " s")
    if case.flight.kind != "waypoints":
        values["gsd_m"] = ("ground sample distance", detector_binning(case)[1], " m")
        values["off_nadir_deg"] = ("off-nadir angle", case.flight.off_nadir_deg, "°")
    outside = []
    for quantity, (words, value, unit) in values.items():
        if fitted := [of[quantity] for of in ranges if quantity in of]:
            low, high = sorted((max(map(min, fitted)), min(map(max, fitted))))
            margin = _MARGIN_DEG if unit == "°" else _MARGIN * value
            if not all(min(one) - margin <= value <= max(one) + margin for one in fitted):
                at = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
                outside.append(f"{words} {value:.3g}{unit} (fitted at {at}{unit})")
    fitted = {of["detector"] for of in ranges if "detector" in of} - {detector}
    outside += [f"detector {detector} (fitted for {other})" for other in fitted]
    if not outside:
        return []
    return [
        f"detector and tracker are used outside their fitted range: {', '.join(outside)}. Fewer vehicles "
        "may be tracked, and more tracks may be false, than with fitted models"
    ]
