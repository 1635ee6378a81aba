"""Controllability and observability matrices and Gramians."""

from jaxtyping import Float

from .._check import check_count, check_step
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
    r"""The controllability matrix $[B,\; A B,\; \dots,\; A^{n-1} B]$.

    The rank of the matrix is the dimension of the controllable subspace. With more than
    a few states the matrix is ill-conditioned. To test controllability, use
    [`delucax.analysis.is_controllable`][] instead, which tests each mode.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.

    **Returns:** the matrix, shape `(n, n m)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.controllability_matrix(upright)
        ```

        ```text
        Array([[0., 3.],
               [3., 0.]], dtype=float32)
        ```
    """
    return _krylov(state_space(model, inputs, "controllability_matrix"))


@host_unless_traced
def observability_matrix(model: LinearModel) -> Float[Array, "np n"]:
    r"""The observability matrix $[C;\; C A;\; \dots;\; C A^{n-1}]$.

    The rank of the matrix is $n$ if the model is observable. With more than a few
    states the matrix is ill-conditioned. To test observability, use
    [`delucax.analysis.is_observable`][] instead.

    **Arguments:** `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
    [`delucax.LinearDynamics`][].

    **Returns:** the matrix, shape `(n p, n)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.observability_matrix(upright)
        ```

        ```text
        Array([[ 1.,  0.],
               [ 0.,  1.],
               [ 0.,  1.],
               [15.,  0.]], dtype=float32)
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
    r"""The controllability Gramian: the covariance of the state under white noise.

    $$W = \int_0^T e^{A t} B B^\top e^{A^\top t} \,\mathrm{d}t, \quad
    \text{or in discrete time} \quad
    W = \sum_{k=0}^{T-1} A^k B B^\top (A^\top)^k$$

    The horizon $T$ is infinite by default. The white noise acts at the inputs and has
    unit intensity (unit covariance in discrete time). To drive the state from zero to
    $x$, the inputs need at least the energy $x^\top W^{-1} x$. $W$ is differentiable to
    any order, in forward and reverse mode.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `horizon`: the horizon $T$, in units of time for a model in continuous time, and
        in steps for a model in discrete time. By default the horizon is infinite, which
        requires a stable model.
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.
    - `throw`: raise an error if `horizon` is not given and the model is not stable
        (default). If false, return infinity.

    **Returns:** the Gramian, shape `(n, n)`, symmetric.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, if `horizon`
    is not positive, or if `inputs` is unknown. With `throw`, an error at run time if
    `horizon` is not given and the model is not stable.

    Source: Van Loan, 1978 (finite horizon).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[0.5]]), jnp.array([[1.0]])
        dlx.analysis.controllability_gramian(dlx.LinearDynamics(A, B))
        ```

        ```text
        Array([[1.333]], dtype=float32)
        ```
    """
    where = "controllability_gramian"
    return _gramian(state_space(model, inputs, where), horizon, throw, where)


@host_unless_traced
def observability_gramian(
    model: LinearModel, horizon: RealScalar | None = None, *, throw: bool = True
) -> Float[Array, "n n"]:
    r"""The observability Gramian: the output energy from an initial state.

    $$W = \int_0^T e^{A^\top t} C^\top C e^{A t} \,\mathrm{d}t, \quad
    \text{or in discrete time} \quad
    W = \sum_{k=0}^{T-1} (A^\top)^k C^\top C A^k$$

    The horizon $T$ is infinite by default. If the model starts at the state $x$ and its
    inputs are zero, the energy of the outputs is $x^\top W x$. $W$ is differentiable to
    any order, in forward and reverse mode.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `horizon`: the horizon $T$, in units of time for a model in continuous time, and
        in steps for a model in discrete time. By default the horizon is infinite, which
        requires a stable model.
    - `throw`: raise an error if `horizon` is not given and the model is not stable
        (default). If false, return infinity.

    **Returns:** the Gramian, shape `(n, n)`, symmetric.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or if
    `horizon` is not positive. With `throw`, an error at run time if `horizon` is not
    given and the model is not stable.

    Source: Van Loan, 1978 (finite horizon).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[-1.0]]), jnp.array([[1.0]])
        system = dlx.systems.LinearSystem(A, B)
        dlx.analysis.observability_gramian(system, horizon=2.0)
        ```

        ```text
        Array([[0.491]], dtype=float32)
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
        check_step(horizon, where, "horizon")
        return _gramian_over(system, xp.asarray(horizon, system.A.dtype))
    W, stable = _gramian_of_all_time(system)
    message = (
        f"{where}: the model must be stable for a Gramian over all time. Give a "
        "horizon, or pass throw=False to return infinity."
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
    return xp.where(stable, W, system.infinity()), stable


@full_precision
def stable_gramian(system: StateSpace) -> Float[Array, "n n"]:
    """The controllability Gramian of a stable model over all time."""
    noise = system.B @ system.B.T
    return symmetric(lyapunov(system.is_discrete, system.A.T, noise))


@compiled_unless_on_host
@full_precision
def _gramian_over(system: StateSpace, horizon: int | Scalar) -> Float[Array, "n n"]:
    A, Q = system.A, system.B @ system.B.T
    if not isinstance(horizon, int):
        return gramian_over(A, Q, horizon)
    # Doubling, W_2k = W_k + A^k W_k (A^k)', along the bits of the number of steps. It
    # takes logarithmic time, and the model need not be stable.
    W, power = xp.zeros_like(Q), system.eye
    for bit in bin(horizon)[2:]:
        W, power = W + power @ W @ power.T, power @ power
        if bit == "1":
            W, power = Q + A @ W @ A.T, A @ power
    return symmetric(W)
