"""The regressor against the equations of motion that it is linear in, and what can be told apart."""

from dataclasses import replace

import numpy as np
import pytest

from config.conversion import dynamics_parameters
from config.loading import load_config
from mechanism.dynamics import LinkParameters, inverse_dynamics_along
from mechanism.errors import ParameterError
from mechanism.five_bar import Closure
from mechanism.regressor import PARAMETER_NAMES, base_columns, from_vector, regressor, to_vector

PAPER = dynamics_parameters(load_config("paper"))
ODD = replace(
    PAPER,
    q=LinkParameters(0.07, 0.11, 0.013, 3e-4),
    r=LinkParameters(0.03, 0.16, -0.008, 2e-4),
    p=LinkParameters(0.4, 0.07, 0.02, 1e-3),
    s=LinkParameters(0.05, 0.09, -0.01, 1e-4),
)
CLOSURE = Closure.LEFT


def random_states(count=400, seed=2):
    generator = np.random.default_rng(seed)
    theta = np.stack([generator.uniform(0.3, 2.8, count), generator.uniform(0.2, 1.6, count)], axis=1)
    return theta, generator.normal(0.0, 8.0, (count, 2)), generator.normal(0.0, 100.0, (count, 2))


@pytest.mark.parametrize("params", [PAPER, ODD])
def test_regressor_times_parameters_is_the_inverse_dynamics(params):
    states = random_states()
    torque = np.zeros((400, 2))
    inverse_dynamics_along(params.to_array(), *states, int(CLOSURE), 0.1, torque)
    usable = np.isfinite(torque).all(axis=1)
    assert usable.sum() > 300
    predicted = regressor(params, CLOSURE, *states, 0.1) @ to_vector(params)
    assert predicted[usable] == pytest.approx(torque[usable], rel=1e-9, abs=1e-9)


def test_the_vector_and_the_bodies_are_each_others_inverse_where_it_matters():
    back = from_vector(to_vector(ODD), replace(ODD, p=replace(ODD.p, mass_kg=0.9), s=replace(ODD.s, mass_kg=0.02)))
    assert to_vector(back) == pytest.approx(to_vector(ODD), rel=1e-12)
    assert [back.q.com_m, back.q.com_perp_m, back.q.inertia_com_kg_m2] == pytest.approx([0.11, 0.013, 3e-4])
    assert back.p.inertia_com_kg_m2 > 0.0


def test_a_body_that_cannot_be_is_refused():
    for name, value, sentence in (
        ("q.inertia", -1e-5, "identified inertia of link q about its joint is -1e-05, but must be positive"),
        ("p.inertia", 1e-5, "identified inertia of link p about its pivot is -0.00011"),
    ):
        vector = to_vector(PAPER)
        vector[PARAMETER_NAMES.index(name)] = value
        with pytest.raises(ParameterError, match=sentence):
            from_vector(vector, PAPER)


def test_a_body_without_the_mass_that_it_needs_gets_it_from_the_one_that_carries_it():
    vector = to_vector(PAPER)
    vector[PARAMETER_NAMES.index("q.mass")] = 0.02
    bodies = from_vector(vector, PAPER)
    assert bodies.q.inertia_com_kg_m2 > 0.0
    assert bodies.q.mass_kg > 0.02
    states = random_states(60)
    torque = np.zeros((60, 2))
    inverse_dynamics_along(bodies.to_array(), *states, int(CLOSURE), 0.1, torque)
    usable = np.isfinite(torque).all(axis=1)
    assert (regressor(PAPER, CLOSURE, *states, 0.1) @ vector)[usable] == pytest.approx(
        torque[usable], rel=1e-9, abs=1e-9
    )


def test_what_cannot_be_told_apart_is_found():
    matrix = regressor(PAPER, CLOSURE, *random_states(), 0.1).reshape(-1, len(PARAMETER_NAMES))
    matrix = matrix[np.isfinite(matrix).all(axis=1)]
    base = base_columns(matrix, np.maximum(np.abs(to_vector(PAPER)), 1e-4))
    # q's mass is carried by p: it adds p to p's moment and p^2 to its inertia. r's is carried by s. A mass where q and
    # r meet may be either's, or the end effector's. That makes four columns too many.
    assert len(base) == len(PARAMETER_NAMES) - 4
    p = PAPER.five_bar.p
    combination = np.zeros(len(PARAMETER_NAMES))
    for name, value in (("q.mass", 1.0), ("p.moment_along", -p), ("p.inertia", -p * p)):
        combination[PARAMETER_NAMES.index(name)] = value
    assert np.abs(matrix @ combination).max() < 1e-9 * np.abs(matrix).max()
