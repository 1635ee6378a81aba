"""Poles, zeros, and tests of modal controllability and observability."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from .._check import check_positive, is_concrete
from .._jax import compiled_unless_on_host, host_unless_traced, stop_gradient, vmap, xp
from .._module import shown
from .._typing import Array, BoolScalar, RealScalar, Scalar
from ..math._linear_solve import eigenvalues
from ._state_space import LinearModel, state_space, StateSpace


_SEARCHES = 3


class ModalTest(eqx.Module):
    """The distance of each mode to uncontrollability (to unobservability).

    **Attributes:**

    - `modes`: the eigenvalues of `A`, shape `(n,)`, complex.
    - `distances`: for each, the smallest singular value of
        `[(A - mode I) / |A|, B / |B|]` (of `[(A - mode I)' / |A|, C' / |C|]` for
        observability), shape `(n,)`: the relative change of the matrices that makes the
        mode uncontrollable (unobservable); zero if it is so already.
    - `unstable`: which modes are on or outside the boundary of stability.
    - `tolerance`: distances up to it count as zero.

    The measurements have no gradient.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.1, 0.0], [0.0, 0.5]])
        dynamics = dlx.LinearDynamics(A, jnp.array([[0.0], [1.0]]))
        test = dlx.analysis.modal_controllability(dynamics)
        test.rank_deficient, test.worst  # the mode 1.1
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
        """Which modes are uncontrollable (unobservable): the matrix of the test loses
        rank there."""
        # Negated, so that a NaN counts as one of them.
        return ~(self.distances > self.tolerance)

    @property
    @host_unless_traced
    def worst(self) -> tuple[Complex[Array, ""], Scalar]:
        """The least controllable (observable) mode, and its distance."""
        k = xp.argmin(self.distances)
        return self.modes[k], self.distances[k]

    @property
    @host_unless_traced
    def worst_unstable(self) -> tuple[Complex[Array, ""], Scalar]:
        """`worst` among the unstable modes; an infinite distance if there is none."""
        distances = xp.where(self.unstable, self.distances, xp.inf)
        k = xp.argmin(distances)
        return self.modes[k], distances[k]


@host_unless_traced
def modal_controllability(
    model: LinearModel, *, inputs: str = "controls", tolerance: RealScalar | None = None
) -> ModalTest:
    """The controllable modes, by the test of Popov, Belevitch and Hautus,

    `rank [A - lambda I, B] = n` at each eigenvalue `lambda` of `A`.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.
    - `tolerance`: relative distances up to it count as zero; `10 n` rounding units by
        default.

    **Returns:** a [`delucax.analysis.ModalTest`][] of all modes.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown.

    Source: Hautus, 1969; Eising, 1984 (the distance).

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.modal_controllability(upright).distances
        ```
    """
    where = "modal_controllability"
    return _modal_test(state_space(model, inputs, where), tolerance, where)


@host_unless_traced
def modal_observability(
    model: LinearModel, *, tolerance: RealScalar | None = None
) -> ModalTest:
    """The observable modes, by the same test of the transposed system,

    `rank [A' - lambda I, C'] = n` at each eigenvalue `lambda` of `A`.

    **Arguments:** `model` and `tolerance`: as in
    [`delucax.analysis.modal_controllability`][].

    **Returns:** a [`delucax.analysis.ModalTest`][] of all modes.

    **Raises:** `ValueError` if `model` is not linear or is time-varying.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.modal_observability(upright).worst
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

    **Raises:** `ValueError`, as there.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        assert dlx.analysis.is_controllable(upright)
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

    **Raises:** `ValueError`, as there.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.1, 0.0], [0.0, 0.5]])
        dynamics = dlx.LinearDynamics(A, jnp.array([[1.0], [0.0]]))
        assert dlx.analysis.is_stabilizable(dynamics)
        assert not dlx.analysis.is_controllable(dynamics)
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

    **Raises:** `ValueError`, as there.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        assert dlx.analysis.is_observable(upright)
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

    **Raises:** `ValueError`, as there.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.1, 0.0], [0.0, 0.5]])
        dynamics = dlx.LinearDynamics(A, jnp.eye(2), C=jnp.array([[1.0, 0.0]]))
        assert dlx.analysis.is_detectable(dynamics)
        ```
    """
    test = modal_observability(model, tolerance=tolerance)
    return ~xp.any(test.rank_deficient & test.unstable)


@host_unless_traced
def poles(model: LinearModel) -> Complex[Array, " n"]:
    """The eigenvalues of `A`.

    They have first derivatives, in either mode, where they are simple. There is no
    order among them.

    **Arguments:** `model`: a [`delucax.systems.LinearSystem`][], stable if all poles
    have a negative real part; or time-invariant [`delucax.LinearDynamics`][], stable if
    all have a modulus below 1.

    **Returns:** shape `(n,)`, complex.

    **Raises:** `ValueError` if `model` is not linear or is time-varying.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.analysis.poles(upright)  # +3.87 and -3.87 per second
        ```
    """
    return eigenvalues(state_space(model, "controls", "poles").A)


def _modal_test(
    system: StateSpace, tolerance: RealScalar | None, where: str
) -> ModalTest:
    eps = xp.finfo(system.A.dtype).eps
    if tolerance is None:
        tolerance = float(10 * len(system.A) * eps)
    check_positive(tolerance, "tolerance", where)
    return _tested(system, xp.asarray(tolerance, system.A.dtype))


@compiled_unless_on_host
def _tested(system: StateSpace, tolerance: Scalar) -> ModalTest:
    system = stop_gradient(system)
    eps = xp.finfo(system.A.dtype).eps
    # Scaled, so that a distance is relative to each of the matrices.
    scale_A, scale_B = (
        xp.where(norm > 0, norm, 1)
        for norm in (xp.linalg.norm(system.A), xp.linalg.norm(system.B))
    )
    A, B = system.A / scale_A, system.B / scale_B
    # A defective eigenvalue is only known to a root of the rounding.
    radius = eps ** (1 / 3)

    def distance(mode):
        """The smallest singular value, and the best `mode` for its vector."""
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
    unstable = system.growth(modes) >= 0
    return ModalTest(modes, distances, unstable, tolerance)


@host_unless_traced
def zeros(model: LinearModel, *, inputs: str = "controls") -> Complex[Array, " zeros"]:
    """The invariant zeros: where `[[A - z I, B], [C, 0]]` loses rank.

    Each step deflates the directly observable states, and then, in the transposed
    system, the directly controllable ones, until the zeros remain. Their number depends
    on the values, which therefore cannot be traced.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.

    **Returns:** complex, as many as there are; those that are also poles included.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, if `inputs` is
    unknown, or under `jax.jit`, `jax.vmap` and `jax.grad`.

    Source: Emami-Naeini and Van Dooren, 1982.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-2.0, -3.0]])
        B = jnp.array([[0.0], [1.0]])
        system = dlx.systems.LinearSystem(A, B, C=jnp.array([[5.0, 1.0]]))
        dlx.analysis.zeros(system)  # -5
        ```
    """
    system = state_space(model, inputs, "zeros")
    if not all(is_concrete(M) for M in (system.A, system.B, system.C)):
        raise ValueError(
            "zeros: model must be concrete, got one that is being traced (by jax.jit, "
            "jax.vmap or jax.grad); how many zeros there are depends on its values."
        )
    A, B, C, D = (np.asarray(M) for M in system[:4])
    # NumPy: the sizes of the reduced systems depend on ranks.
    total = np.linalg.norm(np.block([[A, B], [C, D]]))
    tolerance = 10 * sum(A.shape) * np.finfo(A.dtype).eps * total
    A, B, C, D = _hidden_part(A, B, C, D, tolerance)
    # Of the transposed system: D is then of full row rank, so in the end it is square.
    A, C, B, D = (M.T for M in _hidden_part(A.T, C.T, B.T, D.T, tolerance))
    if not len(A):
        return xp.zeros(0, complex)
    # Closed by the input that keeps the outputs zero, the remaining modes are zeros.
    left = A - B @ np.linalg.solve(D, C) if D.size else A
    return eigenvalues(left)


def _hidden_part(A, B, C, D, tolerance):
    """The states that the outputs do not observe under some input, by the reduction of
    Emami-Naeini and Van Dooren."""
    while True:
        # Compress the rows of D: the outputs in `free` do not depend on the inputs.
        left, values, _ = np.linalg.svd(D) if D.size else (np.eye(len(C)), [], None)
        rank = int(np.sum(np.asarray(values) > tolerance))
        C, D = left.T @ C, left.T @ D
        free = C[rank:]
        # The states that are observed in these outputs.
        _, values, right = (
            np.linalg.svd(free) if free.size else ([], [], np.eye(len(A)))
        )
        count = int(np.sum(np.asarray(values) > tolerance))
        if count == 0:
            return A, B, C[:rank], D[:rank]
        shown, hidden = right[:count].T, right[count:].T
        C = np.concatenate([C[:rank] @ hidden, shown.T @ A @ hidden])
        D = np.concatenate([D[:rank], shown.T @ B])
        A, B = hidden.T @ A @ hidden, hidden.T @ B
