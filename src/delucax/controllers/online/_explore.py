"""Online control of an unknown plant."""

from collections.abc import Callable
from dataclasses import KW_ONLY
from typing import NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, Int, PyTree

from ..._check import as_matrix, check_count, check_key, check_step
from ..._controller import AbstractController, check_controller, wrong_observation
from ..._module import function_field, parameter
from ..._typing import PRNGKey, Real, RealScalar
from ...dynamics import LinearDynamics
from ...math._linear_solve import solve
from ._closed_loop import shift


class ExploreState(NamedTuple):
    """The state of an `Explore` controller.

    - `step`: the number of steps so far.
    - `excitations`: the last random controls, newest first.
    - `clipped`: what the environment added to the last control, by clipping.
    - `moments`: sums of the products of the state and `clipped` with the random control
        `j + 1` steps before the state, shape `(order + 1, n + m, m)`.
    - `model`: the identified dynamics. `arrays`: the arrays of its controller.
        `inner`: the state of that controller.
    - `key`: the random key of the next control.
    """

    step: Int[Array, ""]
    excitations: Float[Array, "order+1 m"]
    clipped: Float[Array, " m"]
    moments: Float[Array, "order+1 n+m m"]
    model: LinearDynamics
    arrays: PyTree
    inner: PyTree
    key: PRNGKey


class Explore(AbstractController):
    r"""Explore, identify, then control: an online learner for an unknown linear plant.

    In the first `steps` steps the control is $u_t = -K x_t + a\, e_t$, where the
    entries of $e_t$ are random signs. If the environment clips this control, $c_t$ is
    the applied control minus $u_t$. The correlations of $e_t$ with $c_t$ and with all
    that follows do not depend on the disturbances, even if an adversary chooses them:

    $$N_j = \tfrac1a \operatorname{mean}_t\, x_{t+j+1} e_t^\top, \qquad
    C_j = \tfrac1a \operatorname{mean}_t\, c_{t+j} e_t^\top$$

    $$N_0 \to B\, (I + C_0), \qquad N_j \to (A - B K)\, N_{j-1} + B C_j$$

    So $B = N_0\, (I + C_0)^{-1}$, and $A - B K$ is the least-squares solution of

    $$(A - B K)\, [N_0 \cdots N_{q-1}] = [N_1 - B C_1 \cdots N_q - B C_q]$$

    If clipping removes the random part of a control completely, the identified dynamics
    are not finite.

    After the first `steps` steps, the control comes from the controller that `build`
    makes for the identified dynamics $x_{t+1} = A x_t + B u_t$. With
    [`delucax.controllers.gpc`][] and `steps` near $T^{2/3}$, the regret over $T$ steps
    grows as $T^{2/3}$.

    **Arguments:**

    - `build`: a function that makes a controller for a [`delucax.LinearDynamics`][].
        The function `build` is called under `jax.jit`. If it makes an online learner,
        it must therefore pass a `horizon` to this learner.
    - `K`: a gain that stabilises the plant, shape `(m, n)`; zero if the plant is stable
        without control.
    - `steps`: the number of steps of exploration.
    - `scale`: $a$, the size of the random controls, 1 by default.
    - `order`: $q$, the number of matrices $N_j$ on each side of the least-squares
        problem. By default $q$ is the number `n` of states, because a controllable
        plant reaches any state in `n` steps.
    - `dt`: the control interval, 1 by default.

    **Raises:** `ValueError` if `build` does not make a controller, `K` is not a matrix
    or a number is out of its range; at run time, if there is no random key.

    Source: Hazan, Kakade and Singh, 2020; Chen and Hazan, 2021.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("lds", A=jnp.array([[0.9, 0.3], [0.0, 0.8]]), B=jnp.eye(2))

        K = jnp.zeros((2, 2))

        def build(model):
            base = dlx.controllers.Linear(K)
            return dlx.controllers.gpc(model, env.cost, base=base, horizon=20)

        learner = dlx.controllers.Explore(build, K, steps=200)
        dlx.rollout(env, learner, key=jax.random.key(0), horizon=1000).total_cost
        ```
    """

    build: Callable[[LinearDynamics], AbstractController] = function_field(of="model")
    K: Array = parameter()
    steps: int = eqx.field(static=True)
    _: KW_ONLY
    scale: Real = parameter(1.0)
    order: int = eqx.field(default=None, static=True)
    dt: Real = parameter(1.0)

    def __post_init__(self):
        where, order = "Explore", self.order
        n = as_matrix(self.K, "K", where).shape[1]
        self.order = check_count(n if order is None else order, "order", where)
        self.steps = check_count(self.steps, "steps", where, least=self.order + 2)

    def __check_init__(self):
        as_matrix(self.K, "K", "Explore")
        check_step(self.scale, "Explore", "scale")
        check_step(self.dt, "Explore")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        own = check_key(key, "Explore.init")
        (m, n), dtype = self.K.shape, self.K.dtype
        # A placeholder for the structure of the state. It is stable, so designs exist.
        A, B = jnp.eye(n, dtype=dtype) / 2, jnp.eye(n, m, dtype=dtype)
        model = LinearDynamics(A, B, dt=self.dt)
        arrays, inner = self._designed(model, jr.fold_in(own, 0))
        return ExploreState(
            step=jnp.zeros((), jnp.int32),
            excitations=jnp.zeros((self.order + 1, m), dtype),
            clipped=jnp.zeros(m, dtype),
            moments=jnp.zeros((self.order + 1, n + m, m), dtype),
            model=model,
            arrays=arrays,
            inner=inner,
            key=own,
        )

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        if y.shape != self.K.shape[1:]:
            raise wrong_observation(self, self.K.shape[1], y)
        dtype, y = y.dtype, y.astype(self.K.dtype)
        # Signs e have E[e e'] = I and are independent of all else, so the mean of x e'
        # is the response, for any disturbances. Row j is from j + 1 steps ago.
        response = jnp.concatenate([y, state.clipped])[:, None]
        moments = response * state.excitations[:, None, :] / self.scale**2
        exploring = state.step < self.steps
        moments = jnp.where(exploring, state.moments + moments, state.moments)
        state = state._replace(moments=moments)
        identify = lambda s: self._identified(s)  # noqa: E731
        state = lax.cond(state.step == self.steps, identify, lambda s: s, state)
        key, now = jr.split(state.key)
        excitation = self.scale * jr.rademacher(now, (self.K.shape[0],), y.dtype)
        acted, inner = self._controller(state)(t, y, state.inner)
        u = jnp.where(exploring, -self.K @ y + excitation, acted.astype(y.dtype))
        state = state._replace(
            inner=_where(exploring, state.inner, inner),
            excitations=shift(excitation, state.excitations),
            clipped=-u,  # `applied` adds the control after clipping
            key=key,
        )
        return u.astype(dtype), state

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        inner = self._controller(state).applied(u, cost, state.inner)
        inner = _where(state.step < self.steps, state.inner, inner)
        clipped = state.clipped + u.astype(state.clipped.dtype)
        return state._replace(inner=inner, clipped=clipped, step=state.step + 1)

    def _identified(self, state: ExploreState) -> ExploreState:
        # There are j fewer observations of lag j.
        counts = self.steps - 1 - jnp.arange(self.order + 1)
        moments = state.moments / counts[:, None, None].astype(state.moments.dtype)
        N, C = jnp.split(moments, [self.K.shape[1]], axis=1)
        B = solve(jnp.eye(len(C[0]), dtype=C.dtype) + C[0].T, N[0].T).T
        before = jnp.concatenate(list(N[:-1]), axis=1)
        after = jnp.concatenate(list(N[1:] - B @ C[1:]), axis=1)
        gram = before @ before.T
        # Regularised, for directions that were not excited.
        least = jnp.finfo(gram.dtype).eps * jnp.trace(gram)
        gram = gram + least * jnp.eye(len(gram), dtype=gram.dtype)
        closed_loop = solve(gram, before @ after.T).T
        # The identified closed loop is A - B K.
        model = LinearDynamics(closed_loop + B @ self.K, B, dt=self.dt)
        arrays, inner = self._designed(model, jr.fold_in(state.key, 0))
        return state._replace(model=model, arrays=arrays, inner=inner)

    def _designed(self, model: LinearDynamics, key: PRNGKey) -> tuple[PyTree, PyTree]:
        """The arrays of the controller for a model, and its initial state."""

        @eqx.filter_jit
        def design(model, key):
            controller = self.build(model)
            check_controller(controller, "what build makes", "Explore")
            return eqx.filter(controller, eqx.is_array), controller.init(key=key)

        # `lax.cond` needs the same types in both branches: none may be weak.
        def strong(x):
            is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
            return x if is_key else lax.convert_element_type(x, x.dtype)

        return jax.tree.map(strong, design(model, key))

    def _controller(self, state: ExploreState) -> AbstractController:
        """The controller with the arrays in the state.

        All else in it is the same for every model.
        """
        build = lambda model: eqx.filter(self.build(model), eqx.is_array, inverse=True)
        return eqx.combine(state.arrays, eqx.filter_eval_shape(build, state.model))


def _where(condition: Array, yes: PyTree, no: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
