"""
8. A trade study
================

One flight is a demonstration. A study flies many cases that differ in what you want to know and says what
moves the scores, by how much, and how sure that is. This tutorial flies a few rows of the paper's **Table
1** and plots track completeness, Eq. (13), against time for each.
"""

import json
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

from glintrack.study import (
    StudyFolder,
    analyse,
    read_plan,
    read_results,
    run_study,
    serial,
    write_results,
)

FULL = os.environ.get("GLINTRACK_DOCS_FULL") == "1"

# %%
# The file of a study
# -------------------
# A base case, and axes with their values: the case's own keys, or a name of your own whose values set
# several. The reduced size sees the middle of the city, for six seconds.

TEXT = """
name = "a few rows of Table 1"
case = "quickstart"
design = "one-at-a-time"      # each row by itself, from the first values

[base]
sensor.oversampling = 1
bound.every = 0
sensor.rows = 160
sensor.columns = 260
flight.azimuth_from_sun_deg = 0

[constraints]
slant_range_m = 3000          # the altitude follows the off-nadir angle
duration_s = 6

[axes]
flight.off_nadir_deg = [50, 0]
navigator = [
    { label = "perfect", navigation.preset = "perfect" },
    { label = "2 m, 0.05°", navigation.position_rms_m = 2.0, navigation.heading_rms_deg = 0.05 },
]
"""
if FULL:
    TEXT = TEXT.replace("sensor.rows = 160\nsensor.columns = 260\n", "").replace(
        "duration_s = 6", "duration_s = 16"
    )

# %%
# Run it
# ------
# ``glintrack study FILE`` does all of this, with a process a core; here the cases fly one after the other.
# What is finished is kept: a study that was stopped goes on where it was.

work = Path(tempfile.mkdtemp())
(work / "few_rows.toml").write_text(TEXT, encoding="utf-8")
plan, folder = read_plan(work / "few_rows.toml"), StudyFolder(work / "study")
print(f"{len(plan.points)} points of the design, {len(plan.cases)} cases")
with folder.open(plan), serial() as pool:
    report = run_study(plan, folder, pool, cache=work / "hits")
    write_results(plan, folder)
print(
    f"{report.finished} cases flown, {report.frames_traced} frames traced and {report.frames_read} read again"
)

# %%
# What it says
# ------------
# A row a point and channel, with its levels and scores; the same on any number of workers.

table, source = read_results(folder.path)
scores = ["completeness", "completeness_visible", "purity", "false_per_frame"]
table[["flight.off_nadir_deg", "navigator", "channel", *scores]].round(3)

# %%
# ``analyse`` gives the change of each score from an axis's first value, with intervals that draw blocks of
# the flight's time: that is all the independence one flight has. For a decision fly replicates (``seeds``).

effects = analyse(table, source)["effects"]
effects = effects[effects["response"] == "completeness"]
effects.round(3)

# %%
# Track completeness against time, and the rows of Table 1
# --------------------------------------------------------
# Completeness counts all moving vehicles in the 660 m × 420 m window, so that in the reduced field most of
# them are out of sight: look at the differences.

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.4), layout="constrained")
for (_, point), style in zip(table[table["channel"] == "pan"].iterrows(), ("-", "--", ":"), strict=True):
    over_time = json.loads(point["over_time"])["completeness"]
    name = f"{point['flight.off_nadir_deg']}° from nadir, navigator {point['navigator']}"
    left.plot([k / 2 for k in range(len(over_time))], over_time, style, color="#648fff", label=name)
left.set(title="Pan", xlabel="time [s]", ylabel="track completeness", ylim=(0, None))
left.legend()
left.grid(alpha=0.3)
effects = effects.assign(row=effects["axis"] + "\n" + effects["level"])
names = list(dict.fromkeys(effects["row"]))
for channel, colour, shift in (("pan", "#648fff", -0.12), ("dolp", "#dc267f", 0.12)):
    part = effects[effects["channel"] == channel]
    height = [names.index(row) + shift for row in part["row"]]
    right.hlines(height, part["low"], part["high"], color=colour)
    right.plot(part["effect"], height, "o", color=colour, label=channel)
right.axvline(0, color="0.3", linewidth=0.8)
right.set_yticks(range(len(names)), names)
right.set(
    title="Change of completeness, 95 % interval", xlabel="track completeness", ylim=(-0.6, len(names) - 0.4)
)
right.legend()
plt.show()

# %%
# The paper's table and ours
# --------------------------
# .. list-table::
#    :header-rows: 1
#    :widths: 50 50
#
#    * - the paper, Table 1 and Section 4.2
#      - ours
#    * - lists thirteen design parameters with the values tried; no result is printed
#      - every row is in ``cases/table1.toml``, whose results are the `Findings <../findings.html>`__
#    * - completeness is to be plotted against time, purity as one number a run
#      - both, for every case, with intervals
#    * - off-nadir angle of 0°, 20° and 50°
#      - of the visible vehicles as many are held within 0.05; less ground is seen from one distance
#    * - "perfect flight path; navigation system noise; aircraft jitter"
#      - a navigator of the best class and jitter cost nothing that is told from chance

# sphinx_gallery_thumbnail_number = 1
