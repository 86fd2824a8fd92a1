"""
3. A city with traffic
======================

The paper flies over a synthetic Rochester, DIRSIG's Megascene #1, with more than two hundred vehicles
driven by SUMO. Here the same ground area, 660 m × 420 m, is drawn from a seed; a recorded SUMO run drives
in it. The tutorial ends in the ground of the paper's **Figure 12**: the area from straight above, trees
removed.
"""

import os

import matplotlib.pyplot as plt
import numpy as np

from glintrack import Case
from glintrack.case.build import trace_frame
from glintrack.flight import FlightDesign
from glintrack.render.frame import render_product
from glintrack.render.preview import preview
from glintrack.results.figures.frame import radiance_colours
from glintrack.scene import SceneDesign, build_scene
from glintrack.sensor import SensorDesign

FULL = os.environ.get("GLINTRACK_DOCS_FULL") == "1"

# %%
# What stands and what drives
# ---------------------------
# A design is a frozen model with a default for everything; `Keys of a case <../reference/case.html>`__
# lists them. ``city.assumptions`` says in sentences what was not in the data.

city = build_scene(SceneDesign(city="embedded"))
now = city.at(30.0)
print(f"{len(city.static.faces):,} triangles of ground, streets and buildings")
print(f"{now.fixed:,} trees, hedges and parked vehicles, stored once a model and placed")
truth = city.truth(30.0)
speed = np.hypot(truth["east_speed_m_s"], truth["north_speed_m_s"])
inside = ((abs(truth["east_m"]) < 330) & (abs(truth["north_m"]) < 210)).values
print(
    f"{inside.sum()} vehicles in the window, {(inside & (speed > 1.0)).values.sum()} of them moving at 30 s"
)

# %%
# ``preview`` looks at a city with the default atmosphere's light and the sensor's own shading, from the
# side, the street or above. ``glintrack scene preview`` does the same from the command line.

figure, axis = plt.subplots(figsize=(9, 5.4), layout="constrained")
axis.imshow(preview(city, "oblique", columns=1600 if FULL else 800).picture)
axis.set_title("The embedded city from the south-west")
axis.set_axis_off()

# %%
# Traffic
# -------
# The recording gives every vehicle at any time. Where they go, and how fast:

figure, axis = plt.subplots(figsize=(9, 5.6), layout="constrained")
for lane in city.lanes:
    axis.plot(*lane.T, color="0.85", linewidth=2, zorder=1)
for t in np.arange(20.0, 40.0, 1.0):
    at = city.truth(t)
    fast = np.hypot(at["east_speed_m_s"], at["north_speed_m_s"])
    dots = axis.scatter(at["east_m"], at["north_m"], s=3, c=fast, cmap="viridis", vmin=0, vmax=14, zorder=2)
west, south, east, north = city.extent_m
axis.set(
    title="Vehicles of the embedded city over 20 s, each second",
    xlabel="east [m]",
    ylabel="north [m]",
    xlim=(west, east),
    ylim=(south, north),
    aspect="equal",
)
figure.colorbar(dots, label="speed [m s⁻¹]", shrink=0.8)

# %%
# Figure 12's ground
# ------------------
# A case puts a camera over it: straight down from 3000 m, panchromatic. The reduced size has a quarter of the
# elements over the same field.

elements = {} if FULL else {"rows": 280, "columns": 440, "pitch_um": 34.0}
nadir = FlightDesign(off_nadir_deg=0.0, altitude_m=3000.0, start_s=30.0, frames=1)
pictures = {}
for trees in (False, True):
    case = Case(scene=SceneDesign(trees=trees), flight=nadir, sensor=SensorDesign(**elements))
    view = trace_frame(case, 0)
    _, light = render_product(view, "radiance")
    pictures[trees] = light[:, :, 0, 0]  # the only band, S0

figure, axes = plt.subplots(2, 1, figsize=(9, 11.5), layout="constrained")
for axis, (trees, pan) in zip(axes, pictures.items(), strict=True):
    colours, scale = radiance_colours(pan)
    axis.imshow(colours, extent=(west, east, south, north))
    axis.set(
        title=f"Panchromatic from 3000 m, straight down, {'with' if trees else 'without'} trees",
        xlabel="east [m]",
        ylabel="north [m]",
        autoscale_on=False,
    )
    figure.colorbar(scale, ax=axis, shrink=0.8, label="radiance [W m⁻² sr⁻¹ µm⁻¹]")
moving = city.truth(30.0).isel(vehicle=np.flatnonzero(speed > 1.0))
axes[0].scatter(
    moving["east_m"], moving["north_m"], s=60, facecolors="none", edgecolors="#ffb000", linewidths=0.8
)
plt.show()

# %%
# The paper's figure and ours
# ---------------------------
# .. list-table::
#    :header-rows: 1
#    :widths: 50 50
#
#    * - the paper, Figure 12
#      - ours
#    * - 660 m × 420 m of Megascene #1, Tile #1, from nadir: houses and streets of Rochester's suburbs, a
#        model made by hand after air photographs
#      - the same extent of a city drawn by rule, with relief of 6 m: another place, of the same kind
#    * - all trees initially removed, for the best tracking
#      - the same (above), and with trees (below): crowns hide a good part of the streets
#    * - queried pixels and labelled tracks drawn over it
#      - rings round what moves, from the truth. Tracks follow in `tutorial 7 <07_track.html>`__
#    * - over 200 vehicles by SUMO
#      - 201 to 224 by SUMO, about half of them waiting at signals
