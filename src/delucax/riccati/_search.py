"""How a Riccati solver goes on until it has a certified solution or knows why not."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._results import choose, Result, RESULTS


# What an attempt is made at.
FIRST, SECOND, SHAKEN, PLAIN, DONE = range(5)
"""The problem; the problem from another start; the problem with a state weight less by
rounding, which has no solution if that of the problem is on the boundary; the problem
with unit weights, which has a solution if and only if the pair is stabilisable."""


class Attempt(NamedTuple):
    """One candidate for the stabilising solution."""

    X: Array
    residual: Array
    bound: Array  # spectral radius or abscissa of the closed loop
    margin: Array  # how far it is from the boundary; rounding counts as none
    near: Array  # whether it is so close that the boundary has to be looked at
    iterations: Array


class Found(NamedTuple):
    """The best attempt, and what the others told."""

    X: Array
    residual: Array
    bound: Array
    iterations: Array
    solved: Array
    stable: Array
    near: Array
    fragile: Array
    stabilisable: Array
    posed: Array

    @property
    def differentiable(self) -> Array:
        return self.stable & jnp.all(jnp.isfinite(self.X)) & self.posed


def tolerance(dtype: Any) -> float:
    """The relative residual up to which an equation counts as solved."""
    return 1e-12 if jnp.finfo(dtype).bits == 64 else 1e-5


def search(attempt: Callable[[Array], Attempt], X: Array, posed: Array) -> Found:
    """Make attempts at the kinds of problem above, as few as are needed.

    Most problems are solved by the first. In a batch, the others are made if any member
    has need of them.
    """
    dtype = X.dtype
    close = tolerance(dtype)

    def more(carry):
        return carry[0] != DONE

    def body(carry):
        kind, found = carry
        new = attempt(kind)
        stable = new.margin > 0
        solved = stable & (new.residual <= close)
        given = kind <= SECOND
        # A second start that fails replaces the first only by being stable.
        take = given & (solved | (kind == FIRST) | stable & ~found.stable)

        def pick(now, before):
            return jnp.where(take, now, before)

        survives = stable & (new.residual <= close**0.5)
        found = found._replace(
            X=pick(new.X, found.X),
            residual=pick(new.residual, found.residual),
            bound=pick(new.bound, found.bound),
            iterations=found.iterations + jnp.where(given, new.iterations, 0),
            solved=pick(solved, found.solved),
            stable=pick(stable, found.stable),
            near=pick(new.near, found.near),
            fragile=jnp.where(kind == SHAKEN, ~survives, found.fragile),
            stabilisable=jnp.where(kind == PLAIN, survives, found.stabilisable),
        )
        after_given = jnp.where(
            solved,
            jnp.where(new.near, SHAKEN, DONE),
            jnp.where(kind == FIRST, SECOND, PLAIN),
        )
        after_shaken = jnp.where(survives, DONE, PLAIN)
        after = jnp.where(kind == SHAKEN, after_shaken, DONE)
        return jnp.where(given, after_given, after), found

    number = jnp.asarray(jnp.inf, dtype)
    no, yes = jnp.asarray(False), jnp.asarray(True)
    nothing = Found(
        X, number, number, jnp.asarray(0), no, no, no, no, stabilisable=yes, posed=posed
    )
    start = jnp.where(posed, FIRST, DONE)
    return lax.while_loop(more, body, (start, nothing))[1]


def verdict(found: Found) -> Result:
    """The status of what was found."""
    good = found.solved & ~found.fragile
    result = choose(found.stable, RESULTS.not_converged, RESULTS.not_stabilising)
    on_boundary = found.fragile | (found.near & ~found.solved)
    result = choose(on_boundary, RESULTS.on_boundary, result)
    result = choose(found.stabilisable, result, RESULTS.not_stabilisable)
    result = choose(good, RESULTS.successful, result)
    return choose(found.posed, result, RESULTS.ill_posed)
