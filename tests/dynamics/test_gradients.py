"""Every way to differentiate a closed loop against central differences."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    central_difference,
    in_both_modes,
    needs_x64,
)

import delucax as dlx


pytestmark = needs_x64
CONTROLLER = diffrax.PIDController(rtol=1e-9, atol=1e-11)


class Noisy(dlx.AbstractSystem):
    state_names = ("angle", "velocity")
    control_names = ("torque",)
    disturbance_names = ("noise",)
    length: jax.Array = dlx.parameter(1.0)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], 15 / self.length * jnp.sin(x[0]) + 3 * u[0]])

    def diffusion(self, t, x, u):
        return jnp.stack([0.0 * x[0], 0.3 * jnp.cos(x[0])])[:, None]


class Scalar(dlx.AbstractSystem):
    state_names = ("x",)
    control_names = ("u",)
    length: jax.Array = dlx.parameter(1.0)

    def vector_field(self, t, x, u, w):
        return u - jnp.sin(x) / self.length

    def diffusion(self, t, x, u):
        return 0.2 * (1 + x**2)


def _pendulum(solver, **kwargs):
    return dlx.Discretized(dlx.systems.Pendulum(), 0.05, solver, **kwargs)


CASES = {
    "Euler": lambda: _pendulum(diffrax.Euler()),
    "RK4": lambda: _pendulum(dlx.dynamics.RK4()),
    "Heun, substeps": lambda: _pendulum(diffrax.Heun(), substeps=3),
    "ImplicitEuler": lambda: _pendulum(diffrax.ImplicitEuler()),
    "Kvaerno3": lambda: _pendulum(diffrax.Kvaerno3()),
    # `test_late_times.py` and `test_integration.py` have the other adjoints.
    "adaptive": lambda: _pendulum(diffrax.Bosh3(), stepsize_controller=CONTROLLER),
    "Euler-Maruyama": lambda: dlx.Discretized(Noisy(), 0.05, substeps=2),
    "Heun, Stratonovich": lambda: dlx.Discretized(Noisy(), 0.05, diffrax.Heun()),
    "Milstein": lambda: dlx.Discretized(Scalar(), 0.05, diffrax.ItoMilstein()),
}


def _cost(dynamics):
    n = dynamics.state_size
    cost = dlx.costs.Quadratic(jnp.eye(n), 0.1 * jnp.eye(1), final=jnp.eye(n))
    env = dlx.Environment(dynamics, cost, horizon=12)

    def total(leaves):
        plant = dlx.replace(env, {"dynamics.system.length": leaves[0]})
        controller = dlx.controllers.Linear(leaves[None, 1 : 1 + n])
        return dlx.rollout(
            plant,
            controller,
            key=jax.random.key(0),
            x0=leaves[1 + n : 1 + 2 * n],
            throw=False,
        ).total_cost

    at = jnp.array([1.1, 8.0, 2.0, 0.3, -0.2])
    return total, at if n == 2 else at[jnp.array([0, 1, 3])]


@pytest.mark.parametrize("name", CASES)
def test_gradients_are_central_differences(name):
    total, at = _cost(CASES[name]())
    if name in ("RK4", "Euler-Maruyama"):
        slopes = jax.jit(in_both_modes(lambda x: total(x)[None]))
    else:
        slopes = jax.jit(jax.value_and_grad(total))
    _, *found = slopes(at)
    value = lambda x: np.squeeze(slopes(x)[0])
    expected = central_difference(value, at, step=1e-5)
    for gradient in found:
        assert_close(gradient.ravel(), expected, atol=1e-8 * np.max(np.abs(expected)))


def test_second_order():
    total, at = _cost(CASES["Euler"]())

    def slope(x):
        found = jax.grad(total)(x)
        return found, found

    both = jax.jit(jax.jacfwd(slope, has_aux=True))
    expected = central_difference(lambda x: both(x)[1][1], at, step=1e-5)
    assert_close(both(at)[0][1], expected, rtol=1e-8, atol=1e-9)
