"""Controllability and observability: Krylov matrices and Gramians."""

from jaxtyping import Float

from .._check import check_count, check_positive
from .._jax import compiled_unless_on_host, host_unless_traced, xp
from .._results import raise_if
from .._typing import Array, BoolScalar, RealScalar, Scalar
from ..math._linear_solve import full_precision, symmetric
from ..math._lyapunov import gramian_over, lyapunov
from ._state_space import LinearModel, state_space, StateSpace


@host_unless_traced
def controllability_matrix(
    model: LinearModel, *, inputs: str = "controls"
) -> Float[Array, "n nm"]:
    """The Krylov matrix `[B, A B, ..., A^(n-1) B]`.

    Its rank is the dimension of the controllable subspace, but ill-conditioned beyond a
    few states: [`delucax.analysis.is_controllable`][] tests mode by mode instead.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.

    **Returns:** shape `(n, n m)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.controllability_matrix(upright)
        ```
    """
    return _krylov(state_space(model, inputs, "controllability_matrix"))


@host_unless_traced
def observability_matrix(model: LinearModel) -> Float[Array, "np n"]:
    """The Krylov matrix `[C; C A; ...; C A^(n-1)]`.

    **Arguments:** `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
    [`delucax.LinearDynamics`][].

    **Returns:** shape `(n p, n)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.observability_matrix(upright)
        ```
    """
    return _krylov(state_space(model, "controls", "observability_matrix").dual).T


@host_unless_traced
def controllability_gramian(
    model: LinearModel,
    horizon: RealScalar | None = None,
    *,
    inputs: str = "controls",
    throw: bool = True,
) -> Float[Array, "n n"]:
    """The covariance of the state under unit white noise at the inputs,

    the integral of `exp(A t) B B' exp(A' t)`, or in discrete time the sum of
    `A^k B B' (A')^k`, over all time or over a horizon. `x' W^-1 x` is the least energy
    of inputs that reach `x` from rest. Differentiable to any order, in either mode.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `horizon`: the time in continuous time, a positive number; the number of steps in
        discrete time, a whole number. All time by default, which needs a stable model.
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.
    - `throw`: raise if there is no horizon and the model is not stable (default); if
        false, return infinity there.

    **Returns:** shape `(n, n)`, symmetric.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `horizon`
    or `inputs` is not as above; an error at run time as `throw` says.

    Source: Van Loan, 1978 (over a horizon).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[0.5]]), jnp.array([[1.0]])
        dlx.analysis.controllability_gramian(dlx.LinearDynamics(A, B))  # 4/3
        ```
    """
    where = "controllability_gramian"
    return _gramian(state_space(model, inputs, where), horizon, throw, where)


@host_unless_traced
def observability_gramian(
    model: LinearModel, horizon: RealScalar | None = None, *, throw: bool = True
) -> Float[Array, "n n"]:
    """The energy `x' W x` of the outputs from a state `x`,

    `W` being the integral of `exp(A' t) C' C exp(A t)`, or in discrete time the sum of
    `(A')^k C' C A^k`, over all time or over a horizon. Differentiable to any order, in
    either mode.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `horizon`: the time in continuous time, a positive number; the number of steps in
        discrete time, a whole number. All time by default, which needs a stable model.
    - `throw`: raise if there is no horizon and the model is not stable (default); if
        false, return infinity there.

    **Returns:** shape `(n, n)`, symmetric.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `horizon`
    is not as above; an error at run time as `throw` says.

    Source: Van Loan, 1978 (over a horizon).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[-1.0]]), jnp.array([[1.0]])
        system = dlx.systems.LinearSystem(A, B)
        dlx.analysis.observability_gramian(system, horizon=2.0)
        ```
    """
    where = "observability_gramian"
    return _gramian(state_space(model, "controls", where).dual, horizon, throw, where)


def _gramian(
    system: StateSpace, horizon: RealScalar | None, throw: bool, where: str
) -> Float[Array, "n n"]:
    if horizon is not None:
        if system.is_discrete:
            return _gramian_over(system, check_count(horizon, "horizon", where))
        check_positive(horizon, "horizon", where)
        return _gramian_over(system, xp.asarray(horizon, system.A.dtype))
    W, stable = _gramian_of_all_time(system)
    message = (
        f"{where}: the model must be stable for a Gramian over all time. Give a "
        "horizon, or pass throw=False for infinity."
    )
    return raise_if(~stable, W, message) if throw else W


@compiled_unless_on_host
def _krylov(system: StateSpace) -> Float[Array, "n nm"]:
    blocks = [system.B]
    for _ in range(system.A.shape[0] - 1):
        blocks.append(system.A @ blocks[-1])
    return xp.concatenate(blocks, axis=1)


@compiled_unless_on_host
def _gramian_of_all_time(system: StateSpace) -> tuple[Float[Array, "n n"], BoolScalar]:
    stable = system.is_stable()
    W = stable_gramian(system.stable_or_placeholder(stable))
    return xp.where(stable, W, xp.inf), stable


@full_precision
def stable_gramian(system: StateSpace) -> Float[Array, "n n"]:
    """The controllability Gramian over all time of a stable model."""
    noise = system.B @ system.B.T
    return symmetric(lyapunov(system.is_discrete, system.A.T, noise))


@compiled_unless_on_host
@full_precision
def _gramian_over(system: StateSpace, horizon: int | Scalar) -> Float[Array, "n n"]:
    A, Q = system.A, system.B @ system.B.T
    if not isinstance(horizon, int):
        return gramian_over(A, Q, horizon)
    # By doubling, W_2k = W_k + A^k W_k (A^k)', along the bits of the number of steps:
    # logarithmic work, and no assumption of stability.
    W, power = xp.zeros_like(Q), system.eye
    for bit in bin(horizon)[2:]:
        W, power = W + power @ W @ power.T, power @ power
        if bit == "1":
            W, power = Q + A @ W @ A.T, A @ power
    return symmetric(W)
