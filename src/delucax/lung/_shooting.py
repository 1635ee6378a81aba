"""Finds the controls of a breath by gradient descent through a lung."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, PyTree

from .._check import check_count, check_instance
from .._controller import AbstractController
from .._module import parameter, positive
from .._typing import PRNGKey, RealScalar
from ..environments import Environment
from ._learned_lung import LearnedLung
from ._ventilation import waveform_of
from ._waveform import as_pips, BreathWaveform, check_waveform, LENGTH, PIPS


class ShootingMPC(AbstractController):
    r"""Model predictive control with a learned lung, by gradient descent.

    While the true lung is ventilated, the controller simulates the learned lung with
    the same controls. A fixed gain corrects the pressure of the learned lung towards
    the measured pressure. At each step, some iterations of Adam improve a plan of the
    next controls, so that the predicted pressure follows the target. Then the first
    control of the plan is applied. The controls of the plan are $u = 100 \, \sigma(z)$,
    and Adam varies $z$, so the controls always stay between 0 and 100 %.

    **Arguments:**

    - `model`: a [`delucax.lung.LearnedLung`][].
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `horizon`: the number of steps of a plan, 10 by default.
    - `iterations`: the number of iterations of Adam in each step, 30 by default.
    - `learning_rate`: the learning rate of Adam, 0.1 by default.
    - `memory`: the weight of the predicted pressure, from 0 to 1, when the mean of the
        predicted and the measured pressure is taken; 0.7 by default.

    **Raises:** `ValueError` if `model` is not a `LearnedLung`, `waveform` is not a
    `BreathWaveform`, or a count is below 1.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021 (shooting).

    !!! example

        ```python
        import equinox as eqx
        import jax.numpy as jnp
        from delucax import lung

        model = lung.learned_lung().dynamics.dynamics
        few = dict(horizon=3, iterations=2)
        mpc = lung.ShootingMPC(model, lung.BreathWaveform(), **few)
        eqx.filter_jit(mpc)(0.0, jnp.array([5.0]), mpc.init())
        ```
    """

    model: LearnedLung
    waveform: BreathWaveform
    horizon: int = eqx.field(static=True, default=10)
    iterations: int = eqx.field(static=True, default=30)
    learning_rate: Array = parameter(0.1, constraint=positive)
    memory: Array = parameter(0.7)

    def __check_init__(self):
        where = "ShootingMPC"
        check_instance(self.model, LearnedLung, "model", where)
        check_waveform(self.waveform, where)
        check_count(self.horizon, "horizon", where)
        check_count(self.iterations, "iterations", where)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        lung = self.model.resting()
        return lung, jnp.full(self.horizon, -2.0, lung.dtype)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        model, (predicted, plan) = self.model, state
        # An observer with a fixed gain.
        lung = model.corrected(predicted, y[0], 1 - self.memory)
        ahead = t + model.dt * jnp.arange(1, self.horizon + 1)
        target = self.waveform.pressure(ahead)

        def error(plan):
            def body(x, z):
                after, _ = model.advance(0.0, x, _controls(z), None)
                return after, model.pressure(after)

            return jnp.mean(jnp.abs(jax.lax.scan(body, lung, plan)[1] - target))

        # Start from the last plan, whose first control has been used.
        start = jnp.append(plan[1:], plan[-1])
        optimiser = optax.adam(self.learning_rate)
        plan, _ = _descended(error, start, optimiser, self.iterations)
        return _controls(plan[0])[:1].astype(y.dtype), (lung, plan)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        lung, plan = state
        u = jnp.stack([u[0], jnp.zeros_like(u[0])])
        return self.model.advance(0.0, lung, u, None)[0], plan


def least_error(
    env: Environment, *, pips: Any = PIPS, steps: int = 600, horizon: int = LENGTH
) -> Array:
    """Estimate the smallest error that any control of the inspiratory valve can reach.

    The controls of each breath are optimised by gradient descent on a simulation of the
    true lung, without noise of the sensor. If the descent has converged to the optimum,
    no controller can have a smaller error.

    **Arguments:**

    - `env`: a task of a lung.
    - `pips`: the peak pressures of the target, 10, 15, ..., 35 cmH2O by default.
    - `steps`: the number of steps of the gradient descent, 600 by default.
    - `horizon`: the number of steps per episode, 29 by default.

    **Returns:** the mean error at each peak pressure [cmH2O], shape `(pips,)`.

    **Raises:** `ValueError` if the arguments are invalid (for example, a peak pressure
    below PEEP).

    !!! example

        ```python
        import delucax as dlx
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        lung.least_error(env, pips=[20.0], steps=20, horizon=10)
        ```
    """
    where = "least_error"
    pips = as_pips(pips, waveform_of(env, where), where)
    steps = check_count(steps, "steps", where)
    horizon = check_count(horizon, "horizon", where)
    optimiser = optax.adam(optax.cosine_decay_schedule(0.3, steps))

    def of(pip):
        world = BreathWaveform.at_pip(env, pip)
        x0: Any = world.initial_state

        def error(z):
            # The gradient keeps only the states and computes the steps again.
            @jax.checkpoint
            def body(x, inputs):
                k, z = inputs
                step = world.step(k * world.dt, x, _controls(z))
                return step.state, step.cost

            _, costs = jax.lax.scan(body, x0, (jnp.arange(horizon), z))
            return jnp.mean(costs)

        _, errors = _descended(error, jnp.full(horizon, -1.0), optimiser, steps)
        # The least error of all steps, because Adam does not descend at every step.
        return jnp.min(errors, initial=jnp.inf)

    return eqx.filter_jit(jax.vmap(of))(pips)


def _controls(z: Array) -> Array:
    """The controls of both valves in an inspiration, within their bounds for any
    `z`."""
    return jnp.stack([100 * jax.nn.sigmoid(z), jnp.zeros_like(z)])


def _descended(
    error: Callable[[Array], Array],
    z: Array,
    optimiser: optax.GradientTransformation,
    steps: int,
) -> tuple[Array, Array]:
    """Descend along the gradient. Returns the last `z`, and the error before each
    step."""

    def descend(carry, _):
        z, memory = carry
        value, slope = jax.value_and_grad(error)(z)
        change, memory = optimiser.update(slope, memory)
        return ((z + change).astype(z.dtype), memory), value

    (z, _), errors = jax.lax.scan(descend, (z, optimiser.init(z)), None, steps)
    return z, errors
