"""
4. What the aircraft sees
=========================

Rays are traced once: what they meet has no wavelength. The light they bring is then worked out for any band
and any Stokes component. This tutorial renders one frame of the quickstart case, 50° off nadir looking
toward the sun: the paper's **Figure 2**.
"""

import os

import matplotlib.pyplot as plt
import numpy as np

from glintrack import Case
from glintrack.case.build import trace_frame
from glintrack.render import one_sample_each, shade
from glintrack.render.frame import render_product
from glintrack.results.figures.frame import dolp_colours, radiance_colours
from glintrack.stokes import dolp

FULL = os.environ.get("GLINTRACK_DOCS_FULL") == "1"

# %%
# One frame, traced
# -----------------
# Frame 12 is the one nearest to the sun's azimuth. The reduced size has a quarter of the elements over the
# same field.

case = Case.from_name("quickstart")
if not FULL:
    case = case.replace({"sensor.rows": 280, "sensor.columns": 440, "sensor.pitch_um": 34.0})
view = trace_frame(case, frame=12)
print(f"{view.hits.rays.sum():,} rays, {np.median(view.hits.range_m):.0f} m to the ground")

# %%
# Natural colour, panchromatic radiance with its Stokes vector, and from that the degree of polarization:

_, rgb = render_product(view, "rgb")
_, light = render_product(view, "radiance")  # I, Q, U over the sensor's band, 0.4 to 1.0 µm
stokes = light[:, :, 0]
degree = dolp(stokes)

# %%
# Figure 2
# --------

figure, axes = plt.subplots(3, 1, figsize=(9, 16.5), layout="constrained")
axes[0].imshow(rgb[:, :, 0])
axes[0].set_title("(a) natural colour")
for axis, (colours, scale), title, label in (
    (axes[1], radiance_colours(stokes[..., 0]), "(b) panchromatic", "radiance [W m⁻² sr⁻¹ µm⁻¹]"),
    (axes[2], dolp_colours(degree), "(c) degree of linear polarization", "DoLP [1]"),
):
    axis.imshow(colours)
    axis.set_title(title)
    figure.colorbar(scale, ax=axis, shrink=0.8, label=label)
for axis in axes:
    axis.set_axis_off()

# %%
# Spectra
# -------
# The same hits, asked for full spectra at a few elements; not a ray is traced again. One windscreen or
# window, the one polarized most, and sunlit ground of two kinds.

materials = view.city.materials
names = materials["material"].values.tolist()
met = one_sample_each(view.hits).material.reshape(case.sensor.rows, case.sensor.columns)


def brightest(name, values):
    """Element of a material where something is largest, short of the odd one out."""
    place = np.argwhere(met == names.index(name))
    return place[np.argsort(values[tuple(place.T)])[int(0.98 * len(place))]]


elements = {
    "glass": brightest("glass", degree),
    "asphalt": brightest("asphalt", stokes[..., 0]),
    "grass": brightest("grass", stokes[..., 0]),
}
um = view.sky.wavelength_um
spectra = shade(
    view.hits, view.sky, materials, pixels=np.array(list(elements.values())), wavelength_um=um
).values
figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
for name, spectrum, colour in zip(elements, spectra, ("#648fff", "0.35", "#009e73"), strict=True):
    axes[0].plot(um, spectrum[:, 0], color=colour, label=name)
    axes[1].plot(um, dolp(spectrum), color=colour, label=name)
axes[0].set(title="radiance at the lens", ylabel="W m⁻² sr⁻¹ µm⁻¹", xlabel="wavelength [µm]")
axes[1].set(title="its degree of polarization", ylabel="DoLP [1]", xlabel="wavelength [µm]", ylim=(0, 1))
axes[0].legend()
for axis in axes:
    axis.grid(alpha=0.3)
plt.show()

# %%
# The paper's figure and ours
# ---------------------------
# .. list-table::
#    :header-rows: 1
#    :widths: 12 44 44
#
#    * - Figure
#      - the paper shows
#      - ours shows
#    * - 2(a)
#      - a suburb of Rochester in natural colour, oblique, softened by 3 km of air
#      - blocks, houses, car parks and a pond drawn by rule, through the same length of clear air
#    * - 2(b)
#      - the same in grey: bright roofs and roads, vegetation bright too, since the band reaches the near
#        infrared
#      - the same; the flat roof of the market outshines everything
#    * - 2(c)
#      - dark ground and walls; bright glass-topped buildings, house windows and glossy cars
#      - dark ground; bright windows, windscreens and car roofs, and the pond. Asphalt in shade is not quite
#        dark: its own light is weak, and the air in front of it is polarized

# sphinx_gallery_thumbnail_number = 1
