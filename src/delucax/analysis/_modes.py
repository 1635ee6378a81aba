"""Poles, and tests of the controllability and observability of modes."""

import equinox as eqx
from jaxtyping import Bool, Complex, Float

from .._check import check_step
from .._jax import compiled_unless_on_host, host_unless_traced, stop_gradient, vmap, xp
from .._module import shown
from .._typing import Array, BoolScalar, RealScalar, Scalar
from ..math._linear_solve import eigenvalues
from ._state_space import LinearModel, state_space, StateSpace


_SEARCHES = 3


class ModalTest(eqx.Module):
    r"""The distance of each mode from being uncontrollable, or from being unobservable.

    **Attributes:**

    - `modes`: the eigenvalues $\lambda$ of $A$, shape `(n,)`, complex.
    - `distances`: the smallest singular value of $[(A - \lambda I) / |A|,\; B / |B|]$
        for each mode, shape `(n,)`. In a test of observability, $A^\top$ and $C^\top$
        take the place of $A$ and $B$. The distance is the smallest relative change of
        the matrices that makes the mode uncontrollable, so it is zero for a mode that
        is uncontrollable already.
    - `unstable`: whether each mode is on or outside the boundary of stability, shape
        `(n,)`.
    - `tolerance`: a distance up to this number is treated as zero.

    The measurements have no gradient.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.1, 0.0], [0.0, 0.5]])
        dynamics = dlx.LinearDynamics(A, jnp.array([[0.0], [1.0]]))
        test = dlx.analysis.modal_controllability(dynamics)
        test.rank_deficient, test.worst
        ```

        ```text
        (Array([ True, False], dtype=bool),
         (Array(1.1+0.j, dtype=complex64), Array(0., dtype=float32)))
        ```
    """

    modes: Complex[Array, " n"]
    distances: Float[Array, " n"]
    unstable: Bool[Array, " n"]
    tolerance: Scalar

    __repr__ = shown

    @property
    @host_unless_traced
    def rank_deficient(self) -> Bool[Array, " n"]:
        """Which modes are uncontrollable (or unobservable), because the matrix of the
        test loses rank."""
        # Negated, so that a NaN counts as uncontrollable.
        return ~(self.distances > self.tolerance)

    @property
    @host_unless_traced
    def worst(self) -> tuple[Complex[Array, ""], Scalar]:
        """The least controllable (or observable) mode, and its distance."""
        k = xp.argmin(self.distances)
        return self.modes[k], self.distances[k]

    @property
    @host_unless_traced
    def worst_unstable(self) -> tuple[Complex[Array, ""], Scalar]:
        """The least controllable (or observable) unstable mode, and its distance, which
        is infinite if there is no unstable mode."""
        distances = xp.where(self.unstable, self.distances, xp.inf)
        k = xp.argmin(distances)
        return self.modes[k], distances[k]


@host_unless_traced
def modal_controllability(
    model: LinearModel, *, inputs: str = "controls", tolerance: RealScalar | None = None
) -> ModalTest:
    r"""The controllability of each mode, by the test of Popov, Belevitch and Hautus.

    The mode of an eigenvalue $\lambda$ of $A$ is controllable if

    $$\mathrm{rank}\, [A - \lambda I,\; B] = n.$$

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.
    - `tolerance`: a relative distance up to this number is treated as zero; by default
        `10 n` times machine epsilon.

    **Returns:** a [`delucax.analysis.ModalTest`][] of all modes.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, `inputs` is
    unknown, or `tolerance` is not positive.

    Source: Hautus, 1969; Eising, 1984 (the distance).

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.modal_controllability(upright).distances
        ```

        ```text
        Array([0.184, 0.184], dtype=float32)
        ```
    """
    where = "modal_controllability"
    return _modal_test(state_space(model, inputs, where), tolerance, where)


@host_unless_traced
def modal_observability(
    model: LinearModel, *, tolerance: RealScalar | None = None
) -> ModalTest:
    r"""The observability of each mode, by the test of Popov, Belevitch and Hautus.

    The mode of an eigenvalue $\lambda$ of $A$ is observable if

    $$\mathrm{rank}\, [A^\top - \lambda I,\; C^\top] = n.$$

    **Arguments:** `model` and `tolerance`: as in
    [`delucax.analysis.modal_controllability`][].

    **Returns:** a [`delucax.analysis.ModalTest`][] of all modes.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `tolerance`
    is not positive.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.modal_observability(upright).distances
        ```

        ```text
        Array([0.707, 0.707], dtype=float32)
        ```
    """
    where = "modal_observability"
    return _modal_test(state_space(model, "controls", where).dual, tolerance, where)


@host_unless_traced
def is_controllable(
    model: LinearModel, *, inputs: str = "controls", tolerance: RealScalar | None = None
) -> BoolScalar:
    """Whether every mode is controllable.

    **Arguments:** `model`, `inputs` and `tolerance`: as in
    [`delucax.analysis.modal_controllability`][], which tests each mode.

    **Returns:** a boolean scalar.

    **Raises:** as in [`delucax.analysis.modal_controllability`][].

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.is_controllable(upright)
        ```

        ```text
        Array(True, dtype=bool)
        ```
    """
    test = modal_controllability(model, inputs=inputs, tolerance=tolerance)
    return ~xp.any(test.rank_deficient)


@host_unless_traced
def is_stabilizable(
    model: LinearModel, *, inputs: str = "controls", tolerance: RealScalar | None = None
) -> BoolScalar:
    """Whether every unstable mode is controllable.

    **Arguments:** `model`, `inputs` and `tolerance`: as in
    [`delucax.analysis.modal_controllability`][], which tests each mode.

    **Returns:** a boolean scalar.

    **Raises:** as in [`delucax.analysis.modal_controllability`][].

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.1, 0.0], [0.0, 0.5]])
        dynamics = dlx.LinearDynamics(A, jnp.array([[1.0], [0.0]]))
        dlx.analysis.is_stabilizable(dynamics), dlx.analysis.is_controllable(dynamics)
        ```

        ```text
        (Array(True, dtype=bool), Array(False, dtype=bool))
        ```
    """
    test = modal_controllability(model, inputs=inputs, tolerance=tolerance)
    return ~xp.any(test.rank_deficient & test.unstable)


@host_unless_traced
def is_observable(
    model: LinearModel, *, tolerance: RealScalar | None = None
) -> BoolScalar:
    """Whether every mode is observable.

    **Arguments:** `model` and `tolerance`: as in
    [`delucax.analysis.modal_observability`][], which tests each mode.

    **Returns:** a boolean scalar.

    **Raises:** as in [`delucax.analysis.modal_observability`][].

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.is_observable(upright)
        ```

        ```text
        Array(True, dtype=bool)
        ```
    """
    return ~xp.any(modal_observability(model, tolerance=tolerance).rank_deficient)


@host_unless_traced
def is_detectable(
    model: LinearModel, *, tolerance: RealScalar | None = None
) -> BoolScalar:
    """Whether every unstable mode is observable.

    **Arguments:** `model` and `tolerance`: as in
    [`delucax.analysis.modal_observability`][], which tests each mode.

    **Returns:** a boolean scalar.

    **Raises:** as in [`delucax.analysis.modal_observability`][].

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.1, 0.0], [0.0, 0.5]])
        dynamics = dlx.LinearDynamics(A, jnp.eye(2), C=jnp.array([[1.0, 0.0]]))
        dlx.analysis.is_detectable(dynamics)
        ```

        ```text
        Array(True, dtype=bool)
        ```
    """
    test = modal_observability(model, tolerance=tolerance)
    return ~xp.any(test.rank_deficient & test.unstable)


@host_unless_traced
def poles(model: LinearModel) -> Complex[Array, " n"]:
    r"""The poles of a linear model: the eigenvalues of $A$.

    A [`delucax.systems.LinearSystem`][] is stable if all poles have a negative real
    part. [`delucax.LinearDynamics`][] are stable if all poles have a modulus below 1. A
    pole that occurs only once has first derivatives, in forward and reverse mode. The
    poles are in no particular order.

    **Arguments:** `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
    [`delucax.LinearDynamics`][].

    **Returns:** the poles, shape `(n,)`, complex.

    **Raises:** `ValueError` if `model` is not linear or is time-varying.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.poles(upright)
        ```

        ```text
        Array([ 3.873+0.j, -3.873+0.j], dtype=complex64)
        ```
    """
    return eigenvalues(state_space(model, "controls", "poles").A)


def _modal_test(
    system: StateSpace, tolerance: RealScalar | None, where: str
) -> ModalTest:
    eps = xp.finfo(system.A.dtype).eps
    if tolerance is None:
        tolerance = float(10 * len(system.A) * eps)
    check_step(tolerance, where, "tolerance")
    return _tested(system, xp.asarray(tolerance, system.A.dtype))


@compiled_unless_on_host
def _tested(system: StateSpace, tolerance: Scalar) -> ModalTest:
    system = stop_gradient(system)
    eps = xp.finfo(system.A.dtype).eps
    # Scaled, so that distances are relative to the sizes of A and B.
    scale_A, scale_B = (
        xp.where(norm > 0, norm, 1)
        for norm in (xp.linalg.norm(system.A), xp.linalg.norm(system.B))
    )
    A, B = system.A / scale_A, system.B / scale_B
    # A defective eigenvalue is known only up to a root of rounding.
    radius = eps ** (1 / 3)

    def distance(mode):
        """The smallest singular value, and a better mode from its singular vector."""
        pencil = xp.concatenate([A - mode * system.eye, B], axis=1)
        left, values, _ = xp.linalg.svd(pencil, full_matrices=False)
        vector = left[:, -1]
        return values[-1], xp.vdot(vector, A.astype(vector.dtype) @ vector)

    def nearby(eigenvalue):
        first, better = distance(eigenvalue)
        mode, least = eigenvalue, first
        for _ in range(_SEARCHES):
            # The improved mode stays within the error of the eigenvalue.
            step = better - eigenvalue
            length = xp.abs(step)
            step = step * xp.minimum(1, radius / xp.where(length > 0, length, 1))
            mode = eigenvalue + step
            least, better = distance(mode)
        reached = least <= tolerance
        return xp.where(reached, mode, eigenvalue), xp.where(reached, least, first)

    modes, distances = vmap(nearby)(eigenvalues(A))
    modes = modes * scale_A
    # The scale rounds a mode on the boundary of stability to either side. Negated, so
    # that a NaN counts as unstable.
    unstable = ~(system.growth(modes) < -4 * eps * xp.abs(modes))
    return ModalTest(modes, distances, unstable, tolerance)
