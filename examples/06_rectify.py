"""
6. From a tilted detector to the ground
=======================================

A tracker needs frames that lie still. Each ground cell gets its height and is projected into the frame by
collinearity, the paper's Eqs. (4) to (6), with the pose that the navigator *reports*. This tutorial
rectifies one frame in natural colour, pan and DoLP, the paper's **Figure 3**, and then lets the navigator
be wrong.
"""

import os

import matplotlib.pyplot as plt
import numpy as np

from glintrack import Case
from glintrack.case.build import trace_frame
from glintrack.metrics import registration_error
from glintrack.ortho import orthorectify, rectify_array
from glintrack.render.frame import render_product
from glintrack.results.figures.tracks import show_dolp, show_pan, show_rgb
from glintrack.sensor import NavigationDesign, build_sensor, expose, navigate, navigation_errors, serve

FULL = os.environ.get("GLINTRACK_DOCS_FULL") == "1"

# %%
# A frame and its pose
# --------------------
# The reduced size is the middle of the array, over the middle of the city.

case = Case.from_name("quickstart")
if not FULL:
    case = case.replace({"sensor.rows": 280, "sensor.columns": 440})
view = trace_frame(case, frame=12)
sensor = build_sensor(case.sensor, view.sky.wavelength_um)
light = view.radiance
frame = expose(light, sensor, serve((), sensor, view.pose), np.random.default_rng(1))
area_m = view.city.extent_m if FULL else (-160.0, -110.0, 160.0, 110.0)
onto = {"terrain": view.city.terrain, "gsd_m": 0.75 if FULL else 1.0, "area_m": area_m}

# %%
# Figure 3
# --------
# Pan and DoLP come from the sensor's frame, two elements a superpixel; colour from the light at the lens.

_, rgb = render_product(view, "rgb")
colour = rectify_array(rgb[:, :, 0], sensor.camera, view.pose, **onto)
image = orthorectify(frame, sensor.camera, view.pose, **onto)

figure, axes = plt.subplots(3, 1, figsize=(8.5, 16.5), layout="constrained")
show_rgb(axes[0], np.clip(np.nan_to_num(colour, nan=1.0), 0, 1), area_m)
show_pan(axes[1], image)
show_dolp(axes[2], image)
for axis, title in zip(axes, ("(a) natural colour", "(b) panchromatic", "(c) DoLP"), strict=True):
    axis.set_title(title)

# %%
# A navigator that errs
# ---------------------
# ``navigation_errors`` draws what a navigator gets wrong, ``navigate`` reports the pose with it. The error
# on the ground grows with the slant range: 0.05° of heading or roll is 2.6 m at 3 km.

presets = {
    "perfect": NavigationDesign(),
    "pos-av-510": NavigationDesign(preset="pos-av-510"),
    "2 m, 0.05°": NavigationDesign(position_rms_m=2.0, heading_rms_deg=0.05, roll_pitch_rms_deg=0.02),
}
times_s = np.arange(20) / 2.0
figure, axes = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
for (name, design), colour in zip(presets.items(), ("0.3", "#648fff", "#dc267f"), strict=True):
    rngs = [np.random.default_rng([3, k]) for k in range(len(times_s))]
    reported = [navigate(view.pose, error) for error in navigation_errors(design, times_s, rngs)]
    wrong_m = [registration_error(sensor.camera, view.pose, pose) for pose in reported]
    axes[0].plot(times_s, wrong_m, color=colour, marker=".", label=name)
    print(f"{name:12s} {np.sqrt(np.mean(np.square(wrong_m))):6.2f} m on the ground, RMS over 20 frames")
axes[0].set(title="misplacement on the ground", xlabel="time [s]", ylabel="RMS over the frame [m]")
axes[0].legend()
axes[0].grid(alpha=0.3)

# %%
# Change detection sees every kerb and roof that such an error moves. The same frame, rectified with two
# poses of the worst navigator, half a second apart:

first, second = (orthorectify(frame, sensor.camera, pose, **onto)["pan"].values for pose in reported[:2])
west, south, east, north = area_m
shown = axes[1].imshow(
    second - first, cmap="PuOr", vmin=-40, vmax=40, extent=(west, east, south, north), interpolation="nearest"
)
axes[1].set(title="nothing moved: difference of two reports", xlabel="east [m]", ylabel="north [m]")
figure.colorbar(shown, ax=axes[1], shrink=0.8, label="pan [W m⁻² sr⁻¹ µm⁻¹]")
plt.show()

# %%
# The paper's figure and ours
# ---------------------------
# .. list-table::
#    :header-rows: 1
#    :widths: 50 50
#
#    * - the paper, Figure 3
#      - ours
#    * - natural colour, pan and DoLP of one area of interest with fixed boundaries, as if seen from
#        straight above
#      - the same three, with a grid in metres
#    * - nearest-neighbour sampling onto a surveyed elevation map; buildings lean away from the camera,
#        since the map has no buildings
#      - bilinear by default (``method="nearest"`` is the paper's); buildings lean too. ``orthorectify``
#        takes a surface model that leaves out what they hide
#    * - errors of location and Euler angles from a commercial navigator's specification
#      - presets of the same class, and any RMS, drift or vibration of your own
