"""Model predictive control in a learned lung."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from .._check import check_count
from .._controller import AbstractController
from .._module import parameter, positive
from ._learned import LearnedLung
from ._waveform import BreathWaveform, check_waveform


class _Shooting(NamedTuple):
    lung: Array
    plan: Array


class ShootingMPC(AbstractController):
    r"""Plans the next controls in a learned lung, at every step anew.

    The learned lung runs beside the true one under the same controls, and is drawn to
    what the sensor reads. The plan is improved by some steps of Adam on the error to
    the target, and its first control is used. With `u = 100 sigmoid(z)` it keeps the
    bounds of the valve.

    **Arguments:**

    - `model`: a [`delucax.lung.LearnedLung`][].
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `horizon`: steps of a plan, 10 by default.
    - `iterations`: of Adam, 30 by default.
    - `learning_rate`: of Adam, 0.1 by default.
    - `memory`: how much of its own prediction the learned lung keeps when a pressure is
        read, 0.7 by default.

    **Raises:** `ValueError` if `model` is no learned lung, `waveform` none, or a count
    is below 1.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021 (shooting).

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax import lung

        model = lung.learned_lung().dynamics.dynamics
        few = dict(horizon=3, iterations=2)
        mpc = lung.ShootingMPC(model, lung.BreathWaveform(), **few)
        mpc(0.0, jnp.array([5.0]), mpc.init())
        ```
    """

    model: LearnedLung
    waveform: BreathWaveform
    learning_rate: Array = parameter(constraint=positive)
    memory: Array = parameter()
    horizon: int = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(
        self,
        model: LearnedLung,
        waveform: BreathWaveform,
        horizon: int = 10,
        iterations: int = 30,
        learning_rate: Any = 0.1,
        memory: Any = 0.7,
    ):
        where = "ShootingMPC"
        self.model, self.waveform = model, waveform
        self.horizon = check_count(horizon, "horizon", where)
        self.iterations = check_count(iterations, "iterations", where)
        self.learning_rate, self.memory = learning_rate, memory

    def __check_init__(self):
        if not isinstance(self.model, LearnedLung):
            raise ValueError(
                "ShootingMPC: model must be a LearnedLung, got "
                f"{type(self.model).__name__}."
            )
        check_waveform(self.waveform, "ShootingMPC")

    def init(self, *, key=None):
        lung = self.model.resting()
        return _Shooting(lung, jnp.full(self.horizon, -2.0, lung.dtype))

    def __call__(self, t, y, state):
        model = self.model
        lung = model.drawn(state.lung, y[0], 1 - self.memory)
        ahead = t + model.dt * jnp.arange(1, self.horizon + 1)
        target = self.waveform.pressure(ahead)

        def error(plan):
            def body(x, z):
                u = jnp.stack([100 * jax.nn.sigmoid(z), jnp.zeros_like(z)])
                after, _ = model.advance(0.0, x, u, None)
                return after, model.pressure(after)

            return jnp.mean(jnp.abs(jax.lax.scan(body, lung, plan)[1] - target))

        optimiser = optax.adam(self.learning_rate)

        def improve(carry, _):
            plan, memory = carry
            move, memory = optimiser.update(jax.grad(error)(plan), memory)
            return ((plan + move).astype(plan.dtype), memory), None

        start = jnp.append(state.plan[1:], state.plan[-1])
        first = start, optimiser.init(start)
        (plan, _), _ = jax.lax.scan(improve, first, None, self.iterations)
        u = 100 * jax.nn.sigmoid(plan[:1])
        return u.astype(y.dtype), _Shooting(lung, plan)

    def applied(self, u, cost, state):
        u = jnp.stack([u[0], jnp.zeros_like(u[0])])
        lung, _ = self.model.advance(0.0, state.lung, u, None)
        return state._replace(lung=lung)
