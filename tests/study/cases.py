"""A study of cases that cost nothing: their scores follow from their keys, and some misbehave on purpose."""

import os
import signal
import time
from pathlib import Path

BASE = """
channels = ["pan", "dolp"]
[flight]
frames = 8
"""
RAISES, KILLS, KILLS_ONCE, SLOW = 13.0, 66.0, 67.0, 5.0  # of sensor.read_noise_e


def write_study(folder, text, base=BASE):
    """A study's file beside its base case."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "base.toml").write_text(base)
    path = folder / "study.toml"
    path.write_text(f'case = "base.toml"\n{text}')
    return path


TWELVE = """
design = "factorial"
seeds = [1, 2]
[axes]
sensor.pitch_um = [17, 10.8, 8.5]
atmosphere.aerosol = ["clear", "urban"]
"""


def cheap(case, task):
    """Scores that are known functions of pitch, aerosol and seed."""
    noise = case.sensor.read_noise_e
    marker = Path(task.cache or ".") / f"met-{task.case_key}"
    if noise == RAISES:
        raise RuntimeError("the optics fell off")
    if noise == KILLS or (noise == KILLS_ONCE and not marker.exists()):
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if noise == SLOW:
        time.sleep(0.5)
    (marker.parent / f"flown-{task.case_key}-{time.time_ns()}").touch()
    haze = 0.1 * (case.atmosphere.aerosol == "urban")
    scores = {}
    for channel, gain in (("pan", 0.0), ("dolp", 0.2)):
        mean = 0.9 - 0.02 * case.sensor.pitch_um - haze + gain
        wobble = [0.01 * ((k + case.seed) % 4 - 1.5) for k in range(case.flight.frames)]
        scores[channel] = {
            "completeness": mean,
            "purity": 0.5 + gain,
            "false_per_frame": 10 * mean,
            "data_rate_mbit_s": 100 / case.sensor.pitch_um,
            "over_time": {"completeness": [mean + w for w in wobble]},
        }
    return {"scores": scores, "files": {"note.txt": b"flown"}}


def flown(folder):
    """How many cases have been flown to their end with this scratch folder."""
    return len(list(Path(folder).glob("flown-*")))
