"""
2. A sky that polarizes
=======================

Sunlight that air has scattered is polarized, most of all at 90° from the sun. Glass, water and clear-coat
mirror that sky, and reflect its two polarizations differently. What a camera sees of it therefore depends
on where it looks from the sun, which is a row of the paper's Table 1 ("relative sensor azimuth from the
sun") and the reason that its **Figure 2(c)** looks toward the sun. This tutorial solves a sky, holds it
against published numbers, and predicts that figure for a pane of glass.
"""

import matplotlib.pyplot as plt
import numpy as np

from glintrack.atmosphere import AtmosphereDesign, path_stokes, rayleigh_slab, sky_stokes, solve_tables
from glintrack.results.figures import sky as plot_sky
from glintrack.stokes import apply, dolp, linear_diattenuator

# %%
# Held against published rows
# ---------------------------
# Pure Rayleigh scattering has been tabulated since Coulson, Dave and Sekera (1960); Natraj and others
# recomputed the rows to eight digits. Optical depth 0.5, sun at cos θ = 0.2. The tables count Q from the
# horizontal, we from the vertical, so our sign is the opposite; U is the same.

published = [
    (0.0, 0.40, (0.12752450, -0.06066038, 0.05293867)),
    (0.0, 0.92, (0.05643322, -0.01979730, 0.03822653)),
    (0.8, 0.40, (0.18923236, -0.06041229, 0.05293867)),
]
print("albedo   mu      published I, Q, U                 ours")
for albedo, mu, row in published:
    ours = rayleigh_slab(optical_depth=0.5, mu0=0.2, albedo=albedo, mu=mu, azimuth_deg=60.0)
    print(
        f"{albedo:5.1f} {mu:6.2f}   " + " ".join(f"{x:+.6f}" for x in row), "  ", *(f"{x:+.6f}" for x in ours)
    )

# %%
# The sky of a clear summer afternoon
# -----------------------------------
# ``AtmosphereDesign()`` is 3 PM on 15 July in Rochester, New York, as in the paper: air, aerosol and gases,
# solved by discrete ordinates with polarization. Seen as if lying on one's back: north is up and east is
# left. The circle is the sun.

tables = solve_tables(AtmosphereDesign())
figure, axes = plt.subplots(1, 3, figsize=(13, 4.4), layout="constrained", subplot_kw={"projection": "polar"})
units = {"I": "log10 of W m⁻² sr⁻¹ µm⁻¹", "DoLP": "DoLP [1]", "AoP": "angle from the vertical [°]"}
for axis, quantity in zip(axes, units, strict=True):
    mesh = plot_sky.fisheye(axis, tables, 0.55, quantity)
    figure.colorbar(mesh, ax=axis, shrink=0.7, label=units[quantity])

# %%
# A band of strong polarization crosses the sky a quarter of a turn from the sun. The angle of polarization
# stands across the direction to the sun, and turns fast near two neutral points, where the degree is zero.
#
# A pane of glass from the air
# ----------------------------
# A level pane, seen 50° off nadir, mirrors the sky 50° from the zenith in the same azimuth. It reflects the
# two polarizations by Fresnel's formulas: it is a diattenuator with its weaker axis in the vertical plane.

off_nadir = np.radians(50.0)
index = 1.52
inside = np.arcsin(np.sin(off_nadir) / index)
across = (np.sin(off_nadir - inside) / np.sin(off_nadir + inside)) ** 2  # horizontal polarization
upright = (np.tan(off_nadir - inside) / np.tan(off_nadir + inside)) ** 2  # in the vertical plane
glass = linear_diattenuator(upright, across, retardance_rad=np.pi)[:3, :3]  # a mirror turns +45° into -45°
print(f"glass at 50° returns {across:.3f} of horizontal and {upright:.4f} of vertical polarization")

# %%
# The camera is at 1928 m, so 3000 m of lit air lie in between. Asphalt is there for contrast: it scatters
# diffusely and polarizes nothing, so what degree it shows is that of the air in front.

from_sun_deg = np.linspace(-180, 180, 181)
azimuth = tables.attrs["sun_azimuth_rad"] + np.radians(from_sun_deg)
air = path_stokes(tables, 1928.0, off_nadir, azimuth)
through = tables["transmittance"].interp(altitude=1928.0, view_zenith=off_nadir).values[:, None]
pane = through * apply(glass, sky_stokes(tables, off_nadir, azimuth)) + air

level = tables["sun_irradiance"] * np.cos(tables.attrs["sun_zenith_rad"]) + tables["sky_irradiance"]
asphalt = air.copy()
asphalt[..., 0] += through[:, 0] * 0.12 * level.values / np.pi

# %%
# What Figure 2(c) has to show
# ----------------------------

for name, light in (("glass", pane), ("asphalt", asphalt)):
    red = dolp(light[:, int(np.argmin(abs(tables["wavelength"].values - 0.65)))])
    print(f"{name:8s} DoLP at 0.65 µm: {red[90]:.3f} toward the sun, {red[0]:.3f} away from it")

figure, axis = plt.subplots(figsize=(9, 4.8), layout="constrained")
for um, colour in ((0.45, "#648fff"), (0.65, "#dc267f"), (0.85, "#ffb000")):
    band = int(np.argmin(abs(tables["wavelength"].values - um)))
    axis.plot(from_sun_deg, dolp(pane[:, band]), color=colour, label=f"glass, {um} µm")
    axis.plot(from_sun_deg, dolp(asphalt[:, band]), color=colour, linestyle=":", label=f"asphalt, {um} µm")
axis.set(
    xlabel="azimuth of the line of sight from the sun's [°]",
    ylabel="degree of linear polarization [1]",
    title="Level glass and asphalt from 1928 m, 50° off nadir",
    xlim=(-180, 180),
    xticks=range(-180, 181, 45),
    ylim=(0, 1),
)
axis.grid(alpha=0.3)
axis.legend(ncols=3, loc="upper center", fontsize="small")
plt.show()

# %%
# The paper's figure and ours
# ---------------------------
# .. list-table::
#    :header-rows: 1
#    :widths: 50 50
#
#    * - the paper, Figure 2(c)
#      - ours
#    * - a picture of the degree of polarization looking toward the sun at 50° on a clear day. Bright are
#        glass-topped buildings, windows and cars with glossy paint; ground and walls stay dark
#      - the same contrast as curves: level glass is strongly polarized where asphalt shows a few per cent.
#        The picture itself follows in `tutorial 4 <04_frame.html>`__
#    * - no picture of the sky, which came from MODTRAN4-P
#      - the sky is solved, and held to published Rayleigh rows
#    * - states that other sensor angles are "not optimal to achieve high DoLP returns"
#      - level glass has a fifth of its degree of polarization left looking away from the sun

# sphinx_gallery_thumbnail_number = 2
