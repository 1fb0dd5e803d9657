"""Ligament fibres: energy and pull against closed forms and finite differences, in both forms of the code."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.kinematics.direct.search import fibre_load as compiled_fibre_load
from pipeline.kinematics.joint_coordinates import rotation_z
from pipeline.kinematics.ligaments import (
    CORD_STIFFNESS,
    LEAST_PUSH,
    NO_FIBRES,
    NO_LOAD,
    Fibres,
    Ligaments,
    Load,
    fibre_load,
    slack_from_scan,
)

Float = NDArray[np.float64]
#: x, y, theta, z.
Place = tuple[float, float, float, float]
PLACES: list[Place] = [(0.0, 0.0, 0.0, 0.0), (1.5, -2.0, 0.4, 3.0), (-20.0, 8.0, -2.5, -30.0)]
each_place = pytest.mark.parametrize("place", PLACES)


def strands(count: int = 12) -> Fibres:
    """Fibres of a knee's size, about half of them taut at any place."""
    random = np.random.default_rng(5)
    on_reference, on_moving = random.uniform(-30.0, 30.0, (2, count, 3))
    return Fibres(on_reference, on_moving, random.uniform(20.0, 60.0, count), random.uniform(0.1, 3.0, count))


def one(slack_mm: float = 4.0, stiffness: float = 0.3) -> Fibres:
    """One fibre from (3, -1, 2) on the moving body to (5, 6, -4) on the reference."""
    ends = np.array([[5.0, 6.0, -4.0]]), np.array([[3.0, -1.0, 2.0]])
    return Fibres(*ends, np.array([slack_mm]), np.array([stiffness]))


def way_of_one(place: Place) -> Float:
    x, y, theta, z = place
    return np.asarray(rotation_z(theta) @ [3.0, -1.0, 2.0] + [x, y, z] - [5.0, 6.0, -4.0])


@each_place
def test_slope_is_the_derivative_of_the_energy(place: Place) -> None:
    fibres, step = strands(), 1e-5
    alone = [Fibres(*(values[k : k + 1] for values in fibres)) for k in range(12)]
    assert 0 < sum(fibre_load(fibre, place).energy_mm > 0.0 for fibre in alone) < 12
    slopes = []
    for axis in range(4):
        there, back = np.array(place), np.array(place)
        there[axis] += step
        back[axis] -= step
        energies = (fibre_load(fibres, (p[0], p[1], p[2], p[3])).energy_mm for p in (there, back))
        slopes.append((next(energies) - next(energies)) / (2.0 * step))
    np.testing.assert_allclose(fibre_load(fibres, place).slope, slopes, rtol=1e-6, atol=1e-5)


@each_place
def test_one_stretched_fibre_in_closed_form(place: Place) -> None:
    way = way_of_one(place)
    length = float(np.linalg.norm(way))
    pull = 0.3 * (length - 4.0) * way / length
    arm = way + np.array([5.0, 6.0, -4.0]) - [place[0], place[1], place[3]]
    load = fibre_load(one(), place)
    assert load.energy_mm == pytest.approx(0.5 * 0.3 * (length - 4.0) ** 2)
    np.testing.assert_allclose(load.slope, [pull[0], pull[1], np.cross(arm, pull)[2], pull[2]])
    assert load.origin == place[:2]


@each_place
def test_a_slack_fibre_does_nothing(place: Place) -> None:
    length = float(np.linalg.norm(way_of_one(place)))
    slack, taut = (fibre_load(one(slack_mm), place) for slack_mm in (length + 1e-6, length - 1e-6))
    assert slack.energy_mm == 0.0
    np.testing.assert_array_equal(slack.slope, np.zeros(4))
    assert taut.energy_mm > 0.0


def test_no_fibres_are_no_load() -> None:
    assert fibre_load(NO_FIBRES, PLACES[1]) is NO_LOAD
    assert NO_LOAD.push == 1.0
    assert NO_LOAD.energy_mm == 0.0
    assert not NO_LOAD.slope.any()


@each_place
@pytest.mark.parametrize("fibres", [strands(), one(), one(100.0), NO_FIBRES], ids=["many", "one", "slack", "none"])
def test_the_compiled_form_says_the_same(fibres: Fibres, place: Place) -> None:
    slope = np.full(4, np.nan)
    energy = compiled_fibre_load(fibres, np.array(place), slope)
    expected = fibre_load(fibres, place)
    assert energy == pytest.approx(expected.energy_mm, rel=1e-12)
    np.testing.assert_allclose(slope, expected.slope, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("along", "push"), [(-0.7, 1.7), (0.4, 0.6), (0.9999, LEAST_PUSH), (3.0, LEAST_PUSH)])
def test_the_contacts_carry_what_the_fibres_leave_of_the_push(along: float, push: float) -> None:
    assert Load(1.0, np.array([0.2, 0.1, 5.0, along]), (0.0, 0.0)).push == pytest.approx(push)


def ligaments(*stiffness_n: float) -> Ligaments:
    count = len(stiffness_n)
    names = tuple(f"fibre {k}" for k in range(count))
    slack_mm = np.linspace(30.0, 40.0, count)
    return Ligaments(names, np.zeros((count, 3)), np.ones((count, 3)), slack_mm, np.array(stiffness_n))


def test_a_spring_pulls_its_stiffness_times_its_strain() -> None:
    springs = ligaments(500.0, 820.0)
    for push_n in (10.0, 50.0):
        tension = springs.fibres(push_n).stiffness * (0.03 * springs.slack_mm) * push_n
        np.testing.assert_allclose(tension, [0.03 * 500.0, 0.03 * 820.0])
    np.testing.assert_array_equal(springs.fibres(10.0).on_moving, springs.on_moving)
    np.testing.assert_array_equal(springs.fibres(10.0).slack_mm, springs.slack_mm)


@pytest.mark.parametrize("push_n", [0.1, 10.0, 1000.0])
def test_the_push_does_not_stretch_a_cord(push_n: float) -> None:
    cord = ligaments(np.inf).fibres(push_n)
    assert cord.stiffness == pytest.approx([CORD_STIFFNESS])
    assert 1.0 / cord.stiffness < 0.01
    hanging = Fibres(np.zeros((1, 3)), np.zeros((1, 3)), cord.slack_mm, cord.stiffness)
    below = fibre_load(hanging, (0.0, 0.0, 0.0, cord.slack_mm[0] + 0.0099))
    assert below.slope[3] > 1.0


def test_nothing_is_stiffer_than_a_cord() -> None:
    soft, stiff, cord = ligaments(500.0, 1e9, np.inf).fibres(10.0).stiffness
    assert soft < stiff == cord


def test_slack_lengths_from_the_scan() -> None:
    length, stiffness = np.array([30.0, 40.0, 50.0]), np.array([500.0, 820.0, np.inf])
    np.testing.assert_array_equal(slack_from_scan(length, stiffness, 0.0), length)
    slack = slack_from_scan(length, stiffness, 0.04)
    np.testing.assert_allclose((length - slack) / slack, [0.04, 0.04, 0.0])
