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
    """Quadratic in an error of the state and one of the control."""

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
                f"{type(self).__name__}: R has shape {self.R.shape} but the control "
                f"has shape {u.shape}."
            )
        du = self._control_error(u)
        return _form(self.Q, self._state_error(t, x)) + _form(self.R, du)

    def final(self, t: RealScalar, x: State) -> Scalar:
        if self.Qf is None:
            return super().final(t, x)
        return _form(self.Qf, self._state_error(t, x))


class Quadratic(_AbstractQuadratic):
    """`(x - x*)' Q (x - x*) + (u - u*)' R (u - u*)`, and `(x - x*)' Qf (x - x*)`.

    **Arguments:**

    - `Q`: state weight, shape `(n, n)`, symmetric; or its diagonal, shape `(n,)`.
    - `R`: control weight, shape `(m, m)`, symmetric; or its diagonal, shape `(m,)`.
    - `final`: final weight Qf, as `Q`; none by default.
    - `state_target`: x*, shape `(n,)`; zero by default.
    - `control_target`: u*, shape `(m,)`; zero by default.
    - `difference`: `(x, x*) -> deviation`, such as `system.difference`, which wraps
        angles; subtraction by default.

    **Raises:** `ValueError` if a weight is not square, symmetric and finite, or if a
    target does not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1), final=10 * jnp.eye(2))
        same = dlx.costs.Quadratic(jnp.ones(2), jnp.ones(1), final=10 * jnp.ones(2))
        cost(0.0, jnp.ones(2), jnp.zeros(1))
        ```
    """

    Q: Matrix | Vector = parameter()
    R: Matrix | Vector = parameter()
    Qf: Matrix | Vector | None = parameter()
    state_target: Array | None = parameter()
    control_target: Array | None = parameter()
    difference: Difference | None = function_field()

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
        # A weight that is no array is reported by the base class.
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
                f"Quadratic: Q has shape {self.Q.shape} but the state has shape "
                f"{x.shape}."
            )
        target = self.state_target
        if self.difference is not None:
            # From zero, and not x itself, because the difference wraps angles.
            return self.difference(x, jnp.zeros_like(x) if target is None else target)
        return x if target is None else x - target

    def _control_error(self, u: Control) -> Control:
        return u if self.control_target is None else u - self.control_target


class Tracking(_AbstractQuadratic):
    """`e' Q e + u' R u` with `e = h(x) - r(t)`, and `e' Qf e` at the end.

    It has no `targets`, as the reference moves.

    **Arguments:**

    - `Q`: error weight, shape `(p, p)`, symmetric; or its diagonal, shape `(p,)`.
    - `R`: control weight, shape `(m, m)`, symmetric; or its diagonal, shape `(m,)`.
    - `reference`: any function of time to a vector of size p, such as those in
        `delucax.references`.
    - `final`: final weight Qf, as `Q`; none by default.
    - `output`: h, from the state to the vector that follows the reference; the state
        itself by default.

    **Raises:** `ValueError` if a weight is not square, symmetric and finite, or does
    not fit what it weighs.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        circle = lambda t: jnp.stack([jnp.cos(t), jnp.sin(t)])
        cost = dlx.costs.Tracking(jnp.eye(2), jnp.eye(1), circle)
        cost(0.0, jnp.ones(2), jnp.zeros(1))
        ```
    """

    Q: Matrix | Vector = parameter()
    R: Matrix | Vector = parameter()
    reference: Callable[[RealScalar], Array] = function_field()
    Qf: Matrix | Vector | None = parameter()
    output: Callable[[Array], Array] | None = function_field()

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
        check_function(self.reference, "reference", "Tracking", " of time")

    def _state_error(self, t: RealScalar, x: State) -> Vector:
        y = x if self.output is None else self.output(x)
        r = self.reference(t)
        if jnp.shape(r) != y.shape or y.shape != self.Q.shape[:1]:
            raise ValueError(
                f"Tracking: Q has shape {self.Q.shape}, the output {y.shape} and the "
                f"reference {jnp.shape(r)}; these must fit."
            )
        return y - r


def _form(weight: Matrix | Vector, d: Vector) -> Scalar:
    """`d' weight d`, the weight a matrix or its diagonal."""
    # Written out for small sizes, which fuses in the loop of a rollout.
    # Without the factor 1/2 of some textbooks: the Hessian is twice the weight, and the
    # weights are those of the Riccati equations as they are.
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
