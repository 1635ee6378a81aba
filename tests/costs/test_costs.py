import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, once, user_error

import delucax as dlx


pytestmark = once
Q = jnp.array([[2.0, 0.5], [0.5, 1.0]])
R = jnp.array([[0.1]])


def test_quadratic():
    x, u = jnp.array([1.0, -2.0]), jnp.array([3.0])
    cost = dlx.costs.Quadratic(Q, R, final=2 * Q)
    assert_close(cost(0.0, x, u), x @ Q @ x + u @ R @ u, rtol=1e-6)
    assert_close(cost.final(0.0, x), 2 * x @ Q @ x, rtol=1e-6)
    target = dlx.costs.Quadratic(Q, R, state_target=x, control_target=u)
    assert target(0.0, x, u) == 0 and target.final(0.0, x) == 0


def test_a_vector_weighs_as_its_diagonal():
    x, u = jnp.array([1.0, -2.0]), jnp.array([3.0])
    q, r = jnp.array([2.0, 0.5]), jnp.array([0.1])
    vectors = dlx.costs.Quadratic(q, r, final=3 * q)
    matrices = dlx.costs.Quadratic(jnp.diag(q), jnp.diag(r), final=jnp.diag(3 * q))
    assert_close(vectors(0.0, x, u), matrices(0.0, x, u), rtol=1e-6)
    assert_close(vectors.final(0.0, x), matrices.final(0.0, x), rtol=1e-6)
    mixed = dlx.costs.Tracking(q, R, lambda t: jnp.ones(2), final=jnp.diag(q))
    assert_close(mixed(0.0, x, u), 0.5 * 9 + 0.1 * 9, rtol=1e-6)
    assert_close(mixed.final(0.0, x), 0.5 * 9, rtol=1e-6)
    slope = jax.grad(lambda q: dlx.costs.Quadratic(q, r)(0.0, x, u))(q)
    assert_close(slope, x**2)


def test_quadratic_wraps_angles():
    difference = dlx.systems.Pendulum().difference
    target = jnp.array([3.0, 0.0])
    cost = dlx.costs.Quadratic(Q, R, state_target=target, difference=difference)
    x = target + jnp.array([2 * jnp.pi, 0.0])
    assert_close(cost(0.0, x, jnp.zeros(1)), 0.0, atol=1e-9)


def test_tracking():
    reference = dlx.references.FigureEight(period=4.0)
    cost = dlx.costs.Tracking(Q, R, reference, final=Q)
    assert_close(cost(0.7, reference(0.7), jnp.ones(1)), 0.1, rtol=1e-5)
    assert_close(cost.final(1.0, reference(1.0)), 0.0, atol=1e-9)
    first = dlx.costs.Tracking(
        jnp.eye(1), R, lambda t: t * jnp.ones(1), output=lambda x: x[:1]
    )
    assert_close(first(2.0, jnp.array([3.0, 9.0]), jnp.zeros(1)), 1.0)


def test_rate_keeps_the_problem_when_dt_changes():
    inner = dlx.costs.Quadratic(Q, R, final=Q)
    x, u = jnp.ones(2), jnp.ones(1)
    cost = dlx.costs.Rate(inner, 0.05)
    assert_close(cost(0.0, x, u), 0.05 * inner(0.0, x, u), rtol=1e-6)
    assert_close(cost.final(0.0, x), inner.final(0.0, x))


def test_function():
    cost = dlx.costs.Function(lambda t, x, u: t * x[0], lambda t, x: x[1])
    assert cost(2.0, jnp.array([3.0, 4.0]), jnp.zeros(1)) == 6
    assert cost.final(2.0, jnp.array([3.0, 4.0])) == 4
    assert dlx.costs.Function(lambda t, x, u: x[0]).final(0.0, jnp.ones(2)) == 0


def test_weights_are_differentiable():
    def value(q):
        return dlx.costs.Quadratic(q * jnp.eye(2), R)(0.0, jnp.ones(2), jnp.ones(1))

    assert_close(jax.jit(jax.grad(value))(3.0), 2.0)


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: dlx.costs.Quadratic(jnp.ones((2, 3)), R), "Q must be square"),
        (lambda: dlx.costs.Quadratic(jnp.array([[1.0, 1], [0, 1]]), R), "symmetric"),
        (lambda: dlx.costs.Quadratic(2.0, R), "Q must be a matrix or its diag"),
        (lambda: dlx.costs.Quadratic(jnp.ones(2) * jnp.nan, R), "Q must be finite"),
        (lambda: dlx.costs.Quadratic(Q, R, final=jnp.ones(3)), "final must fit Q"),
        (lambda: dlx.costs.Quadratic(jnp.ones(3), R)(0.0, Q[0], R[0]), "state has"),
        (lambda: dlx.costs.Quadratic(Q * jnp.nan, R), "Q must be finite"),
        (lambda: dlx.costs.Quadratic(Q, R, final=jnp.eye(3)), "final must fit Q"),
        (lambda: dlx.costs.Quadratic(Q, R, state_target=jnp.ones(3)), "state_target"),
        (lambda: dlx.costs.Quadratic(Q, R)(0.0, jnp.ones(3), jnp.ones(1)), "state has"),
        (lambda: dlx.costs.Quadratic(Q, R)(0.0, jnp.ones(2), jnp.ones(2)), "control"),
        (lambda: dlx.costs.Tracking(Q, R, jnp.ones(2)), "reference must be a function"),
        (
            lambda: dlx.costs.Tracking(Q, R, lambda t: jnp.ones(3))(
                0.0, jnp.ones(2), jnp.ones(1)
            ),
            "must have the same size",
        ),
        (
            lambda: dlx.costs.Tracking(Q, Q, lambda t: jnp.ones(2))(
                0.0, jnp.ones(2), jnp.ones(1)
            ),
            r"Tracking: R has shape \(2, 2\), but the control has shape \(1,\)",
        ),
        (
            lambda: dlx.costs.Tracking(Q, R, lambda t: jnp.ones(2), final=jnp.eye(3)),
            "Tracking: final must fit Q",
        ),
        (lambda: dlx.costs.Rate(dlx.costs.PendulumCost(), 0.0), "dt must be positive"),
        (
            lambda: dlx.costs.PendulumCost(float("nan")),
            "velocity_weight must be finite",
        ),
    ],
)
def test_bad_arguments(make, match):
    with user_error(match=match):
        make()


def test_costs_add_and_scale():
    """Final costs too; a number may stand on either side, and can be differentiated."""
    x, u = jnp.array([1.0, -2.0]), jnp.array([3.0])
    a = dlx.costs.Quadratic(Q, R, final=2 * Q)
    b = dlx.costs.Function(lambda t, x, u: t + x[0] + u[0], lambda t, x: x[1])
    for cost, p, q in (
        (a + b, 1, 1),
        (2 * a + b, 2, 1),
        (a * 2 + 0.5 * b, 2, 0.5),
        (np.float32(3) * (a + b) * 2, 6, 6),
        (jnp.array(2.0) * a + np.array(0.5) * b + a, 3, 0.5),
    ):
        assert isinstance(cost, dlx.AbstractCost)
        expected = p * a(0.5, x, u) + q * b(0.5, x, u)
        assert_close(cost(0.5, x, u), expected, rtol=1e-6)
        expected = p * a.final(0.5, x) + q * b.final(0.5, x)
        assert_close(cost.final(0.5, x), expected, rtol=1e-6)
    price = jax.jit(lambda weight: (weight * a + b)(0.5, x, u))
    assert_close(jax.grad(price)(2.0), a(0.5, x, u), rtol=1e-6)
    scaled = dlx.replace(a + 2 * b, {"terms.1.factor": 3.0})
    assert_close(scaled(0.5, x, u), a(0.5, x, u) + 3 * b(0.5, x, u), rtol=1e-6)


def test_targets_of_costs_that_are_made_of_others():
    x, u = jnp.array([1.0, 2.0]), jnp.array([3.0])
    effort = dlx.costs.Function(lambda t, x, u: u @ u)
    at_x = dlx.costs.Quadratic(Q, R, state_target=x)
    at_u = dlx.costs.Quadratic(Q, R, control_target=u)

    class Around(dlx.AbstractCost):
        """What any wrapper is."""

        inner: dict[str, dlx.AbstractCost]

        def __call__(self, t, x, u):
            return self.inner["cost"](t, x, u)

    for cost, state, control in (
        (at_x, x, None),
        (2 * at_x + effort, x, None),
        (effort + dlx.costs.Rate(at_x, 0.1) + 0.5 * at_u, x, u),
        (Around({"cost": 3 * (at_u + at_x)}), x, u),
        (dlx.costs.Quadratic(Q, R), None, None),
    ):
        for found, expected in zip(cost.targets, (state, control), strict=True):
            assert (found is None) == (expected is None)
            assert found is None or jnp.all(found == expected)
    tracking = dlx.costs.Tracking(Q, R, lambda t: t * x)
    for cost in (effort, 2 * effort, Around({"cost": tracking}), tracking):
        assert cost.targets is None


def test_what_cannot_be_added():
    cost = dlx.costs.PendulumCost()
    for function in (lambda: cost + 1, lambda: cost * cost, lambda: 1 + cost):
        with user_error(TypeError):
            function()
    with user_error(match="factor must be a number"):
        cost * "2"  # pyright: ignore
    with user_error(match="factor must be a number"):
        jnp.ones(2) * cost
    with user_error(match="Sum: terms must be at least one cost"):
        dlx.costs.Sum()
    with user_error(match="every term must be an AbstractCost"):
        dlx.costs.Sum(cost, 1.0)  # pyright: ignore
