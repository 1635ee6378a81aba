"""Derivatives of programs that may have none in one of the two modes."""

from collections.abc import Callable
from typing import Any

import jax
from jax.interpreters import partial_eval


def first_possible(*derivatives: Callable[..., Any]) -> Callable[..., Any]:
    """The first of some ways to take a derivative that the solvers inside have.

    Some have none in reverse, others none forward. If no way is possible the error is
    that of the first, and so is one that has nothing to do with derivatives.
    """

    def evaluate(*args):
        errors = []
        for derivative in derivatives:
            try:
                return derivative(*args)
            except (RuntimeError, TypeError, ValueError) as error:
                errors.append(error)
        raise errors[0]

    return evaluate


def jacobian(
    f: Callable[..., Any], argnums: int | tuple[int, ...] = 0
) -> Callable[..., Any]:
    """The Jacobian of `f` in forward mode, or in reverse where a solver inside has only
    that."""
    return first_possible(jax.jacfwd(f, argnums), jax.jacrev(f, argnums))


def is_constant(f: Callable[..., Any], *args: Any) -> bool:
    """Whether the array that `f` returns depends on none of its arguments."""
    traced = jax.make_jaxpr(f)(*args)
    _, used = partial_eval.dce_jaxpr(traced.jaxpr, [True])
    return not any(used)
