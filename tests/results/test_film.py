"""The film: its colours, and that it never outgrows its budget."""

import io as memory

import numpy as np
import pytest
from PIL import Image

from glintrack.results.figures import MAX_DOLP
from glintrack.results.film import KINDS, Film, colour_pictures
from tests.report.made import image

RGB = np.full((40, 60, 3), 0.5)


def test_colours_are_those_of_the_scales():
    shown = image()
    shown["dolp"][:] = 0.0
    shown["dolp"][5, 5] = 2 * MAX_DOLP
    pictures = colour_pictures(shown, (10.0, 90.0))
    assert pictures["dolp"][5, 5].tolist() == [253, 231, 37]  # viridis ends in this yellow
    assert pictures["dolp"][9, 9].tolist() == [68, 1, 84]
    assert (
        len(np.unique(pictures["aop"].reshape(-1, 3), axis=0)) <= 2
    )  # unpolarized: no angle but at one cell
    shown["pan"][9, 9], shown["pan"][9, 10] = 5.0, 100.0
    pan = colour_pictures(shown, (10.0, 90.0))["pan"]
    assert pan[9, 9].tolist() == [0, 0, 0] and pan[9, 10].tolist() == [255, 255, 255]


def test_the_angles_colours_close():
    """An angle of 0 and one just under π are the same axis, and look the same."""
    ends = image()
    for column, angle in enumerate((1e-4, np.pi - 1e-4)):
        ends["stokes_radiance"][20, column] = [1, 0.3 * np.cos(2 * angle), 0.3 * np.sin(2 * angle)]
    picture = colour_pictures(ends, (0.0, 1.0))["aop"].astype(int)
    assert np.abs(picture[20, 0] - picture[20, 1]).max() <= 2  # of 255


def test_no_data_and_no_polarizers():
    pictures = colour_pictures(image(), (10.0, 90.0))
    assert len({tuple(p[0, 0]) for p in pictures.values()}) == 1
    assert list(colour_pictures(image(polarized=False), (10.0, 90.0))) == ["pan"]


@pytest.mark.parametrize("budget", [60_000, 400_000])
def test_the_film_keeps_its_budget(budget):
    """Noise is the worst there is to compress."""
    film = Film.of(100, 12, budget)
    assert len(film.frames) == 12 and {0, 99} <= film.frames
    rng = np.random.default_rng(0)
    big = image().pad(x=(0, 340), y=(0, 260), constant_values=1.0)
    for k in sorted(film.frames):
        big["pan"][:] = rng.uniform(0, 1, big["pan"].shape)
        film.add(k, 0.1 * k, big, rng.uniform(0, 1, (*big["pan"].shape, 3)))
    assert sum(map(len, film.pictures.values())) <= budget
    assert set(film.index()["kinds"]) == set(KINDS)
    assert film.index()["times_s"] == sorted(film.index()["times_s"])


def test_natural_colour_survives_the_way():
    film = Film.of(1, 5)
    film.add(0, 0.0, image(), RGB)
    picture = np.asarray(Image.open(memory.BytesIO(film.pictures["rgb", 0])).convert("RGB"))
    assert picture.shape == (40, 60, 3)
    assert np.abs(picture.astype(int) - 128).max() <= 2  # lossy
