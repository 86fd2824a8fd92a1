"""Superpixels by name, and whether their polarizers determine the Stokes vector."""

import math

import numpy as np
import pytest

from glintrack import stokes
from glintrack.sensor.layouts import (
    LAYOUTS,
    analyser_matrix,
    condition_number,
    invert,
    places,
    superpixel,
)


def test_the_inverse_for_ideal_polarizers_is_fesenkovs_formula():
    readings = np.random.default_rng(0).uniform(size=(20, 3))  # twice the irradiance behind each polarizer
    matrix = invert(analyser_matrix(LAYOUTS["mirror-0-60-120"], 1.0))
    np.testing.assert_allclose(readings @ matrix.T, stokes.fesenkov(*(readings.T / 2)), atol=1e-12)


@pytest.mark.parametrize("name", ["mirror-0-60-120", "0-45-90-135"])
@pytest.mark.parametrize("diattenuation", [1.0, 0.73, 0.2])
def test_inverse_undoes_the_analysers(name, diattenuation):
    matrix = analyser_matrix(superpixel(name), diattenuation)
    np.testing.assert_allclose(invert(matrix) @ matrix, np.eye(3), atol=1e-12)
    # both mosaics have equally spaced angles: S1 and S2 weigh D/√2 against S0's 1
    assert condition_number(matrix) == pytest.approx(math.sqrt(2) / diattenuation)


def test_rows_are_those_of_a_mueller_matrix():
    along, across = 0.8, 0.1
    diattenuation = (along - across) / (along + across)
    rows = analyser_matrix(LAYOUTS["0-45-90-135"], diattenuation)
    for row, (i, j) in zip(rows, places(LAYOUTS["0-45-90-135"], "polarizer"), strict=True):
        angle = math.radians(float(LAYOUTS["0-45-90-135"][i][j]))
        whole = stokes.linear_diattenuator(along, across, angle)[0, :3]
        np.testing.assert_allclose(row, whole / whole[0], atol=1e-12)


@pytest.mark.parametrize(
    ("layout", "number"),
    [
        ((("mirror", 0.0), (90.0, 0.0)), "inf"),  # 0° and 90° say nothing of S2
        ((("mirror", 0.0), (60.0, "open")), "inf"),  # two polarizers, three components
        (((0.0, 1.0), (2.0, 1.0)), r"\d"),
    ],
)
def test_polarizers_that_do_not_determine_the_vector_are_refused(layout, number):
    with pytest.raises(
        ValueError, match=rf"determine S0, S1 and S2; got a condition number of ({number}|\d)"
    ):
        invert(analyser_matrix(superpixel(layout), 1.0))


def test_a_polarizer_that_does_not_polarize_is_refused():
    with pytest.raises(ValueError, match="condition number of 141"):
        invert(analyser_matrix(LAYOUTS["mirror-0-60-120"], 0.01))


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ("mirror-0-45", "must be one of mirror-0-60-120, 0-45-90-135, pan, mirror, rgb, four-bands or"),
        ((("mirror", 0.0), (60.0,)), r"must be square, 1 to 4 elements a side; got rows of \[2, 1\]"),
        ((), "must be square"),
        ((("mirror", "mirror"), (0.0, 60.0)), "must hold one mirror at most; got 2"),
        ((("glass", 0.0), (60.0, 120.0)), r"got \['glass'\]"),
        (((math.nan, 0.0), (60.0, 120.0)), "angles in degrees"),
        ((("0.6-0.5", "open"), ("open", "open")), r"such as '0.5-0.6'; got \['0.6-0.5'\]"),
        ((("0.4-0.5", 0.0), (60.0, 120.0)), "must hold filters or polarizers, not both"),
    ],
)
def test_layouts_that_are_none_are_refused(layout, message):
    with pytest.raises(ValueError, match=message):
        superpixel(layout)
