"""Stokes and Mueller algebra against closed forms and against Jones calculus."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glintrack.stokes import (
    aop,
    apply,
    axis_turn,
    dolp,
    fesenkov,
    frame_angle,
    linear_diattenuator,
    rotate,
    rotate_qu,
    rotation_mueller,
)

ROUNDING = 1e-12  # of a few dozen float64 operations on numbers of order one
ANGLES = st.floats(-2 * math.pi, 2 * math.pi)
UNIT = st.floats(0, 1)
TRANSMITTANCES = st.floats(1e-6, 1)
# numpy.kron order of E ⊗ E*: |E1|², E1E2*, E2E1*, |E2|² to I, Q, U = 2Re(E1E2*), V = 2Im(E1E2*)
FROM_COHERENCY = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, -1j, 1j, 0]])
HORIZONTAL, RIGHT = np.array([1, 0]), np.array([1, -1j]) / math.sqrt(2)


def mueller_of(jones):
    """Mueller matrix of a Jones matrix, fields as e^(−iωt)."""
    return (FROM_COHERENCY @ np.kron(jones, np.conj(jones)) @ np.linalg.inv(FROM_COHERENCY)).real


def stokes_of(field):
    """Stokes vector of a complex field (E1, E2)."""
    return (FROM_COHERENCY @ np.kron(field, np.conj(field))).real


@st.composite
def physical_stokes(draw, components=4):
    """Stokes vectors with S0² ≥ S1² + S2² + S3²."""
    total, degree = draw(st.floats(0.01, 100)), draw(UNIT)
    azimuth, z = draw(ANGLES), draw(st.floats(-1, 1)) if components == 4 else 0.0
    across = degree * math.sqrt(1 - z * z)
    vector = [1.0, across * math.cos(azimuth), across * math.sin(azimuth), degree * z]
    return total * np.array(vector[:components])


def unit_vectors(count, seed=0):
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


# --- the meaning of the components -----------------------------------------------------------------


def test_right_circular_turns_clockwise_as_the_receiver_sees_it():
    quarter_periods = np.exp(-0.5j * math.pi * np.arange(4))
    e1, e2 = (RIGHT[:, None] * quarter_periods).real
    assert np.all(e1 * np.roll(e2, -1) - e2 * np.roll(e1, -1) < 0)  # e1 right, e2 up: each step is clockwise
    np.testing.assert_allclose(stokes_of(RIGHT), [1, 0, 0, 1], atol=ROUNDING)


@given(ANGLES)
def test_linear_light_has_its_angle_as_aop(angle):
    field = np.array([math.cos(angle), math.sin(angle)])
    turned = (aop(stokes_of(field)) - angle + math.pi / 2) % math.pi - math.pi / 2
    assert abs(turned) < 1e-7  # arctan2 of numbers that are themselves rounded


# --- Malus, crossed polarizers, Fesenkov -----------------------------------------------------------


@given(ANGLES, ANGLES)
def test_malus(light_angle, polarizer_angle):
    light = [1, math.cos(2 * light_angle), math.sin(2 * light_angle), 0]
    passed = apply(linear_diattenuator(1, 0, polarizer_angle), light)
    assert passed[0] == pytest.approx(math.cos(light_angle - polarizer_angle) ** 2, abs=ROUNDING)


@given(ANGLES, physical_stokes())
def test_crossed_polarizers_pass_nothing(angle, light):
    crossed = linear_diattenuator(1, 0, angle + math.pi / 2) @ linear_diattenuator(1, 0, angle)
    np.testing.assert_allclose(apply(crossed, light), 0, atol=ROUNDING * light[0])


@given(physical_stokes(components=3))
def test_fesenkov_recovers_what_entered_ideal_polarizers(light):
    whole = np.r_[light, 0.0]
    behind = [apply(linear_diattenuator(1, 0, math.radians(a)), whole)[0] for a in (0, 60, 120)]
    np.testing.assert_allclose(fesenkov(*behind), light, rtol=0, atol=ROUNDING * light[0])


def test_fesenkov_takes_whole_frames_and_scalars_alike():
    i0, i60, i120 = np.random.default_rng(1).random((3, 4, 5))
    frame = fesenkov(i0, i60, i120)
    assert frame.shape == (4, 5, 3)
    np.testing.assert_array_equal(frame[2, 3], fesenkov(i0[2, 3], i60[2, 3], i120[2, 3]))
    np.testing.assert_allclose(fesenkov(0.5, 0.5, 0.5), [1, 0, 0], atol=ROUNDING)  # half of unpolarized light


# --- diattenuators against Jones calculus ----------------------------------------------------------


@given(TRANSMITTANCES, TRANSMITTANCES, ANGLES, ANGLES)
def test_diattenuator_equals_its_jones_matrix(passed, blocked, angle, retardance):
    c, s = math.cos(angle), math.sin(angle)
    to_axis = np.array([[c, s], [-s, c]])
    amplitudes = np.diag([math.sqrt(passed) * np.exp(1j * retardance), math.sqrt(blocked)])
    jones = to_axis.T @ amplitudes @ to_axis
    np.testing.assert_allclose(
        linear_diattenuator(passed, blocked, angle, retardance), mueller_of(jones), atol=ROUNDING
    )


def test_a_quarter_wave_lead_of_the_pass_axis_makes_plus_45_right_circular():
    """E1 → i E1 turns (1, 1) into (i, 1) = i·(1, −i): right circular, by hand."""
    plate = linear_diattenuator(1, 1, retardance_rad=math.pi / 2)
    np.testing.assert_allclose(apply(plate, [1, 0, 1, 0]), [1, 0, 0, 1], atol=ROUNDING)
    np.testing.assert_allclose(apply(plate, [1, 0, 0, 1]), [1, 0, -1, 0], atol=ROUNDING)


@given(TRANSMITTANCES, TRANSMITTANCES, ANGLES)
def test_principal_axes_pass_their_transmittances(passed, blocked, angle):
    element = linear_diattenuator(passed, blocked, angle)
    for transmittance, turned in ((passed, angle), (blocked, angle + math.pi / 2)):
        light = np.array([1, math.cos(2 * turned), math.sin(2 * turned), 0])
        np.testing.assert_allclose(apply(element, light), transmittance * light, atol=ROUNDING)


@given(UNIT, UNIT, ANGLES, ANGLES, physical_stokes())
def test_a_passive_element_keeps_light_physical(passed, blocked, angle, retardance, light):
    after = apply(linear_diattenuator(passed, blocked, angle, retardance), light)
    slack = ROUNDING * light[0]
    assert -slack <= after[0] <= light[0] + slack
    assert np.linalg.norm(after[1:]) <= after[0] + slack


@pytest.mark.parametrize("name", ["pass_transmittance", "block_transmittance"])
@pytest.mark.parametrize("value", [-0.01, 1.01, math.nan])
def test_a_transmittance_beyond_0_to_1_is_named(name, value):
    design = {"pass_transmittance": 0.9, "block_transmittance": 0.1, name: value}
    with pytest.raises(ValueError, match=rf"`{name}` must be .*\[0, 1\]; got {value}"):
        linear_diattenuator(**design)


# --- turning the reference axis --------------------------------------------------------------------


@given(physical_stokes(), ANGLES)
def test_rotation_round_trip(light, angle):
    np.testing.assert_allclose(rotate(rotate(light, angle), -angle), light, atol=ROUNDING * light[0])


@given(physical_stokes(), ANGLES, ANGLES)
def test_rotations_add(light, first, second):
    np.testing.assert_allclose(
        rotate(rotate(light, first), second), rotate(light, first + second), atol=10 * ROUNDING * light[0]
    )


@given(physical_stokes(), ANGLES)
def test_rotation_keeps_intensity_degree_and_circularity(light, angle):
    turned = rotate(light, angle)
    assert turned[0] == light[0] and turned[3] == light[3]
    assert dolp(turned) == pytest.approx(dolp(light), abs=ROUNDING)


@given(physical_stokes(), ANGLES)
def test_rotate_is_its_mueller_matrix(light, angle):
    np.testing.assert_allclose(
        apply(rotation_mueller(angle), light), rotate(light, angle), atol=ROUNDING * light[0]
    )


@given(ANGLES)
def test_light_along_the_new_axis_has_q_equal_to_i(angle):
    along = [1, math.cos(2 * angle), math.sin(2 * angle)]
    np.testing.assert_allclose(rotate(along, angle), [1, 1, 0], atol=ROUNDING)


def test_rotate_broadcasts_like_a_loop():
    light = np.random.default_rng(2).random((5, 4))
    angles = np.linspace(0, 3, 7)[:, None]
    batch = rotate(light, angles)
    assert batch.shape == (7, 5, 4)
    for i, angle in enumerate(angles[:, 0]):
        for j in range(5):
            np.testing.assert_array_equal(batch[i, j], rotate(light[j], angle))


def test_rotate_leaves_its_argument_alone():
    light = np.array([1.0, 0.3, 0.2])
    rotate(light, 0.4)
    np.testing.assert_array_equal(light, [1.0, 0.3, 0.2])


def test_rotate_qu_is_rotate_for_kernels():
    q, u = rotate_qu(0.3, -0.2, math.cos(0.8), math.sin(0.8))
    np.testing.assert_allclose([q, u], rotate([1, 0.3, -0.2], 0.4)[1:], atol=ROUNDING)


# --- angles between axes ---------------------------------------------------------------------------


@given(ANGLES)
def test_frame_angle_is_counter_clockwise_as_the_receiver_sees_it(angle):
    """Light coming down the z axis to a viewer below it who looks up: travel −z, turns seen from −z."""
    travel, first = np.array([0, 0, -1.0]), np.array([1.0, 0, 0])
    second = np.cross(travel, first)  # e2 = k × e1: a quarter turn counter-clockwise
    to = math.cos(angle) * first + math.sin(angle) * second
    got = frame_angle(first, to, travel)
    assert abs(math.remainder(got - angle, 2 * math.pi)) < ROUNDING


def test_axis_turn_is_frame_angle():
    a, b, k = (unit_vectors(200, seed) for seed in (3, 4, 5))
    for scale in (1.0, 7.5):  # axes need not be unit vectors
        doubled = 2 * frame_angle(a, scale * b, k)
        got = np.array([axis_turn(*x, *(scale * y), *z) for x, y, z in zip(a, b, k, strict=True)])
        np.testing.assert_allclose(got, np.stack([np.cos(doubled), np.sin(doubled)], 1), atol=1e-10)


def test_only_the_transverse_part_of_an_axis_counts():
    a, b, k = (unit_vectors(50, seed) for seed in (6, 7, 8))
    np.testing.assert_allclose(frame_angle(a + 0.4 * k, b - 0.9 * k, k), frame_angle(a, b, k), atol=1e-10)


def test_turning_there_and_back_is_nothing():
    a, b, k = (unit_vectors(50, seed) for seed in (9, 10, 11))
    np.testing.assert_allclose(np.cos(frame_angle(a, b, k) + frame_angle(b, a, k)), 1, atol=ROUNDING)


def test_an_axis_along_the_ray_does_not_turn():
    assert axis_turn(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0) == (1.0, 0.0)
    assert frame_angle(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0])) == 0


# --- degree and angle ------------------------------------------------------------------------------


@given(physical_stokes())
def test_dolp_of_physical_light_lies_within_0_and_1(light):
    assert 0 <= dolp(light) <= 1 + ROUNDING


def test_dolp_masks_dark_pixels():
    frame = np.array([[2.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.05, 0.0], [-0.2, 0.1, 0.0], [np.nan, 0, 0]])
    np.testing.assert_array_equal(dolp(frame), [0.5, np.nan, 0.5, np.nan, np.nan])
    np.testing.assert_array_equal(dolp(frame, floor=0.1), [0.5, np.nan, np.nan, np.nan, np.nan])


@given(st.floats(-1, 1), st.floats(-1, 1))
def test_aop_lies_in_0_to_pi(q, u):
    assert 0 <= aop([1, q, u]) < math.pi


@pytest.mark.parametrize(
    ("q", "u", "degrees"), [(1, 0, 0), (0, 1, 45), (-1, 0, 90), (0, -1, 135), (1, -1e-300, 0), (1, -0.0, 0)]
)
def test_aop_of_the_principal_directions(q, u, degrees):
    assert math.degrees(aop([1, q, u])) == pytest.approx(degrees, abs=1e-9)


@pytest.mark.parametrize("wrong", [1.0, [1.0, 0.0], np.ones((4, 5))])
def test_what_is_no_stokes_vector_is_refused(wrong):
    for function in (dolp, aop, lambda s: rotate(s, 0.1)):
        with pytest.raises(ValueError, match=r"`stokes` must have 3 or 4 components .* got shape \("):
            function(wrong)
