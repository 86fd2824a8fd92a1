"""A plate under a film: bending stiffness, and the curvature that stress or heat in the film gives it.

Biaxial moduli E/(1−ν), equal strain across the interface (Timoshenko's bimetal, for plates); Stoney's formula
is the limit of a thin film.
"""

from dataclasses import dataclass

from glintrack.devices.micromirror.equilibrium import PlateDesign


@dataclass(frozen=True)
class Laminate:
    """Plate and film as one sheet.

    Parameters
    ----------
    rigidity_nm
        Flexural rigidity D. [N m]
    poisson_ratio
        Of the plate. [1]
    moment_per_strain_n
        Bending moment per length for a film that would be longer than the plate by a strain of 1. [N]
    misfit_strain
        How much longer the film would be, from its built-in stress, without heat. [1]
    misfit_per_k
        The same for each kelvin. [1/K]
    """

    rigidity_nm: float
    poisson_ratio: float
    moment_per_strain_n: float
    misfit_strain: float
    misfit_per_k: float

    def free_curvature(self, temperature_rise_k: float = 0.0) -> float:
        """Curvature of the free sheet, positive where the film's side is convex. [1/m]"""
        strain = self.misfit_strain + self.misfit_per_k * temperature_rise_k
        return self.moment_per_strain_n * strain / (self.rigidity_nm * (1 + self.poisson_ratio))


def laminate(plate: PlateDesign) -> Laminate:
    """Stiffness and misfit of a plate with its film.

    References
    ----------
    Timoshenko, J. Opt. Soc. Am. 11, 233 (1925); Freund and Suresh, Thin Film Materials, 2003, §2.1–2.2.
    """
    h, t = plate.thickness_nm * 1e-9, plate.film_thickness_nm * 1e-9
    biaxial = plate.youngs_modulus_gpa * 1e9 / (1 - plate.poisson_ratio)
    film = plate.film_youngs_modulus_gpa * 1e9 / (1 - plate.film_poisson_ratio)
    extension = biaxial * h + film * t  # heights are counted from the plate's middle toward the film
    middle = h / 2 + t / 2
    neutral = film * t * middle / extension
    bending = biaxial * (h**3 / 12 + h * neutral**2) + film * (t**3 / 12 + t * (middle - neutral) ** 2)
    return Laminate(
        rigidity_nm=bending / (1 + plate.poisson_ratio),
        poisson_ratio=plate.poisson_ratio,
        moment_per_strain_n=film * t * (middle - neutral),
        misfit_strain=-plate.film_stress_mpa * 1e6 / film,
        misfit_per_k=(plate.film_expansion_per_mk - plate.expansion_per_mk) * 1e-6,
    )


def stoney_curvature(plate: PlateDesign) -> float:
    """Curvature from a thin film's stress, 6σt(1−ν)/(Eh²), positive where the film's side is convex. [1/m]

    References
    ----------
    Stoney, Proc. R. Soc. A 82, 172 (1909), with the biaxial modulus.
    """
    h, t = plate.thickness_nm * 1e-9, plate.film_thickness_nm * 1e-9
    biaxial = plate.youngs_modulus_gpa * 1e9 / (1 - plate.poisson_ratio)
    return -6 * plate.film_stress_mpa * 1e6 * t / (biaxial * h**2)
