"""Quadratic costs about a point and about a reference."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_vector, check_finite, check_function, symmetric_matrix
from .._message import shortened
from .._module import function_field, parameter
from .._typing import (
    Control,
    Difference,
    Matrix,
    Numbers,
    RealScalar,
    Scalar,
    State,
    Vector,
)
from ..math import quadratic_form
from ..math._small import dot
from ._base import AbstractCost


class _AbstractQuadratic(AbstractCost):
    """A cost that is quadratic in an error of the state and one of the control."""

    Q: eqx.AbstractVar[Matrix | Vector]
    R: eqx.AbstractVar[Matrix | Vector]
    Qf: eqx.AbstractVar[Matrix | Vector | None]

    def __check_init__(self):
        where = type(self).__name__
        _check_weight(self.Q, "Q", where)
        _check_weight(self.R, "R", where)
        if self.Qf is not None:
            _check_weight(self.Qf, "final", where)
            if len(self.Qf) != len(self.Q):
                raise ValueError(
                    f"{where}: final must fit Q of shape {self.Q.shape}, got shape "
                    f"{self.Qf.shape}."
                )

    @abc.abstractmethod
    def _state_error(self, t: RealScalar, x: State) -> Vector:
        """The error that `Q` weighs."""

    def _control_error(self, u: Control) -> Control:
        """The error that `R` weighs."""
        return u

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        if u.shape != self.R.shape[:1]:
            raise ValueError(
                f"{type(self).__name__}: R has shape {self.R.shape}, but the control "
                f"has shape {u.shape}."
            )
        du = self._control_error(u)
        return _form(self.Q, self._state_error(t, x)) + _form(self.R, du)

    def final(self, t: RealScalar, x: State) -> Scalar:
        if self.Qf is None:
            return super().final(t, x)
        return _form(self.Qf, self._state_error(t, x))


class Quadratic(_AbstractQuadratic):
    r"""A quadratic cost about a target.

    $$(x - x^*)^\top Q (x - x^*) + (u - u^*)^\top R (u - u^*)$$

    The final cost is $(x - x^*)^\top Q_f (x - x^*)$. There is no factor 1/2.

    **Arguments:**

    - `Q`: state weight, shape `(n, n)`, symmetric; or its diagonal, shape `(n,)`.
    - `R`: control weight, shape `(m, m)`, symmetric; or its diagonal, shape `(m,)`.
    - `final`: final weight $Q_f$, symmetric, or its diagonal, like `Q`; no final cost
        by default.
    - `state_target`: $x^*$, shape `(n,)`; zero by default.
    - `control_target`: $u^*$, shape `(m,)`; zero by default.
    - `difference`: a function `(x, x_target) -> deviation` that replaces $x - x^*$,
        such as `system.difference`, which wraps angles; subtraction by default.

    **Raises:** `ValueError` if a weight is not square, symmetric and finite, or if the
    size of a target is wrong.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1), final=10 * jnp.eye(2))
        same = dlx.costs.Quadratic(jnp.ones(2), jnp.ones(1), final=10 * jnp.ones(2))
        cost(0.0, jnp.ones(2), jnp.zeros(1))
        ```

        ```text
        Array(2., dtype=float32)
        ```
    """

    Q: Matrix | Vector = parameter()
    R: Matrix | Vector = parameter()
    Qf: Matrix | Vector | None = parameter()
    state_target: Array | None = parameter()
    control_target: Array | None = parameter()
    difference: Difference | None = function_field(of="a, b")

    def __init__(
        self,
        Q: Numbers,
        R: Numbers,
        final: Numbers | None = None,
        state_target: Numbers | None = None,
        control_target: Numbers | None = None,
        *,
        difference: Difference | None = None,
    ):
        given: Any = Q, R, final, state_target, control_target
        self.Q, self.R, self.Qf, self.state_target, self.control_target = given
        self.difference = difference

    def __check_init__(self):
        # The base class reports a weight that is not an array.
        for name, weight in (("state_target", self.Q), ("control_target", self.R)):
            target = getattr(self, name)
            if target is not None and jnp.ndim(weight) > 0:
                as_vector(target, len(weight), name, "Quadratic")

    @property
    def targets(self) -> tuple[Array | None, Array | None]:
        return self.state_target, self.control_target

    def _state_error(self, t: RealScalar, x: State) -> Vector:
        if x.shape != self.Q.shape[:1]:
            raise ValueError(
                f"Quadratic: Q has shape {self.Q.shape}, but the state has shape "
                f"{x.shape}."
            )
        target = self.state_target
        if self.difference is not None:
            # Also for a zero target, because the difference may wrap angles.
            return self.difference(x, jnp.zeros_like(x) if target is None else target)
        return x if target is None else x - target

    def _control_error(self, u: Control) -> Control:
        return u if self.control_target is None else u - self.control_target


class Tracking(_AbstractQuadratic):
    r"""A quadratic cost of the error with which a plant tracks a moving reference.

    $$e^\top Q e + u^\top R u, \qquad e = h(x) - r(t)$$

    The final cost is $e^\top Q_f e$. The cost has no `targets`, because the reference
    moves.

    **Arguments:**

    - `Q`: error weight, shape `(p, p)`, symmetric; or its diagonal, shape `(p,)`.
    - `R`: control weight, shape `(m, m)`, symmetric; or its diagonal, shape `(m,)`.
    - `reference`: $r$, a function of time that returns a vector of shape `(p,)`, such
        as those in `delucax.references`.
    - `final`: final weight $Q_f$, symmetric, or its diagonal, like `Q`; no final cost
        by default.
    - `output`: $h$, a function of the state that returns the vector that should follow
        the reference, shape `(p,)`; the state itself by default.

    **Raises:** `ValueError` if a weight is not square, symmetric and finite, or if the
    size of a weight does not fit the error or the control.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        circle = lambda t: jnp.stack([jnp.cos(t), jnp.sin(t)])
        cost = dlx.costs.Tracking(jnp.eye(2), jnp.eye(1), circle)
        cost(0.0, jnp.ones(2), jnp.zeros(1))
        ```

        ```text
        Array(1., dtype=float32)
        ```
    """

    Q: Matrix | Vector = parameter()
    R: Matrix | Vector = parameter()
    reference: Callable[[RealScalar], Array] = function_field(of="t")
    Qf: Matrix | Vector | None = parameter()
    output: Callable[[Array], Array] | None = function_field(of="x")

    def __init__(
        self,
        Q: Numbers,
        R: Numbers,
        reference: Callable[[RealScalar], Array],
        final: Numbers | None = None,
        output: Callable[[Array], Array] | None = None,
    ):
        given: Any = Q, R, final
        self.Q, self.R, self.Qf = given
        self.reference, self.output = reference, output

    def __check_init__(self):
        check_function(self.reference, "reference", "Tracking", "t")

    def _state_error(self, t: RealScalar, x: State) -> Vector:
        y = x if self.output is None else self.output(x)
        r = self.reference(t)
        if jnp.shape(r) != y.shape or y.shape != self.Q.shape[:1]:
            raise ValueError(
                "Tracking: Q, the output and the reference must have the same size, "
                f"got shapes {self.Q.shape}, {y.shape} and {jnp.shape(r)}."
            )
        return y - r


def _form(weight: Matrix | Vector, d: Vector) -> Scalar:
    """`d' weight d`, where the weight is a matrix or its diagonal."""
    # Without the factor 1/2 of some textbooks, so that the weights are those of the
    # Riccati equations.
    if weight.ndim == 2:
        return quadratic_form(weight, d)
    return dot(weight * d, d)


def _check_weight(weight: Any, name: str, where: str) -> None:
    """Raise unless `weight` is a symmetric matrix or the diagonal of one."""
    ndim = weight.ndim if eqx.is_inexact_array(weight) else None
    if ndim == 1:
        check_finite(weight, name, where)
    elif ndim == 2:
        symmetric_matrix(weight, name, where)
    else:
        got = f"shape {weight.shape}" if eqx.is_array(weight) else shortened(weight)
        raise ValueError(
            f"{where}: {name} must be a matrix or its diagonal, got {got}."
        )
