"""
0. Fly, change one key, compare
===============================

Does a finer pitch hold more vehicles? Twelve frames of the city at two pitches. The reduced size
is the middle of the city.
"""

import os

import matplotlib.pyplot as plt

from glintrack import Case, simulate

middle = {} if os.environ.get("GLINTRACK_DOCS_FULL") == "1" else {"sensor.rows": 180, "sensor.columns": 280}
changes = {"flight.frames": 12, "bound.every": 0, "channels": ["pan"], **middle}
base = Case.from_name("quickstart").replace(changes)
twice = {"sensor.rows": 2 * base.sensor.rows, "sensor.columns": 2 * base.sensor.columns}
finer = {"sensor.pitch_um": 8.5, **twice}
designs = {"17 µm": base, "8.5 µm, same field": base.replace(finer | {"sensor.oversampling": 1})}
scores = {name: simulate(case)["pan"].attrs for name, case in designs.items()}

# %%
# Vehicles held per km² and false tracks per km², the headline of every report.

figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
for ax, score in zip(axes, ("tracked_per_km2", "false_per_km2"), strict=True):
    bars = ax.bar(list(scores), [of[score] for of in scores.values()], color="#648fff")
    ax.bar_label(bars, fmt="%.0f")
    ax.set_ylabel(score.replace("_per_km2", " per km²"))
