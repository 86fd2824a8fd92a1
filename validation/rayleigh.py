"""Compare `rayleigh_slab` with the published Rayleigh tables of Coulson as recomputed by Natraj.

    python validation/rayleigh.py

Natraj, Li and Yung, Astrophys. J. 691, 1909 (2009): sunlight leaving the top of a Rayleigh slab over a
Lambertian ground, solar flux π, optical depth 0.5, cosine of the sun's zenith angle 0.2, no depolarization.
"""

import numpy as np

from glintrack.atmosphere import rayleigh_slab

OPTICAL_DEPTH, MU0 = 0.5, 0.2
# albedo, μ, azimuth [°], I, Q, U in the table's signs: its Q is the opposite of ours, its U the same
PUBLISHED = (
    (0.0, 0.40, 60.0, 0.12752450, -0.06066038, 0.05293867),
    (0.0, 0.92, 60.0, 0.05643322, -0.01979730, 0.03822653),
    (0.8, 0.40, 60.0, 0.18923236, -0.06041229, 0.05293867),
)


def largest_differences() -> list[float]:
    """Largest difference of I, Q or U from each published row. [1]"""
    found = []
    for albedo, mu, azimuth_deg, i, q, u in PUBLISHED:
        ours = rayleigh_slab(OPTICAL_DEPTH, MU0, albedo, mu, azimuth_deg)
        found.append(float(np.abs(np.asarray(ours) - [i, -q, u]).max()))
    return found


def main() -> None:
    """Print the table."""
    print("| albedo | μ | azimuth [°] | I, published | largest difference |\n|" + " --- |" * 5)
    for (albedo, mu, azimuth_deg, i, *_), difference in zip(PUBLISHED, largest_differences(), strict=True):
        print(f"| {albedo} | {mu} | {azimuth_deg:.0f} | {i:.6f} | {difference:.1e} |")


if __name__ == "__main__":
    main()
