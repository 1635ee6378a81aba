"""How a Riccati solver goes on until it has a certified solution or knows why not."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._results import choose, Result, RESULTS
from ..math._size import size


# What an attempt is made at.
FIRST, BALANCED, SECOND, SHAKEN, PLAIN, LIFTED, DONE = range(7)
"""The problem; the problem in units of the states that balance it, which the attempts
after it keep; the problem from another start; the problem with a state weight less by
rounding, of which a solution on the boundary makes another or none; the problem with
unit weights, which has a solution if and only if the pair is stabilisable; the problem
with a state weight more by the root of rounding, whose loop tells by being close to the
boundary that the problem's is on it."""
_ALIKE = 0.3
"""How much of its distance from the boundary a loop may owe to rounding."""


class Attempt(NamedTuple):
    """One candidate for the stabilising solution."""

    X: Array
    residual: Array  # in units that balance the problem
    given: Array  # the residual in the units that the problem was given in
    bound: Array  # spectral radius or abscissa of the closed loop
    gap: Array  # the distance from the boundary, positive if it is stable
    rounding: Array  # of the gap
    near: Array  # whether the gap is so small that it has to be looked at
    around: Array  # whether it is small
    least: Array  # the residual that rounding of X may leave, in balanced units
    modest: Array  # whether X is far from what rounding makes of an infinite one
    iterations: Array


class Found(NamedTuple):
    """The best attempt, and what the others told."""

    X: Array
    residual: Array
    given: Array
    bound: Array
    iterations: Array
    solved: Array
    gap: Array
    stable: Array
    fragile: Array
    stabilisable: Array
    on_edge: Array
    balanced: Array
    posed: Array

    @property
    def differentiable(self) -> Array:
        return self.stable & jnp.all(jnp.isfinite(self.X)) & self.posed


def tolerance(dtype: Any) -> float:
    """The relative residual up to which an equation counts as solved."""
    return 1e-12 if jnp.finfo(dtype).bits == 64 else 1e-5


def search(
    attempt: Callable[[Array, Array], Attempt], X: Array, posed: Array, apart: Array
) -> Found:
    """Make attempts at the kinds of problem above, as few as are needed.

    An attempt is of a kind, in balanced units or in those given, which may be `apart`.

    Most problems are solved by the first. In a batch, the others are made if any member
    has need of them.
    """
    dtype = X.dtype
    close = tolerance(dtype)

    def more(carry):
        return carry[0] != DONE

    def body(carry):
        kind, found = carry
        balanced = found.balanced | (kind == BALANCED)
        new = attempt(kind, balanced)
        stable = new.gap > new.rounding
        # No X of this precision may come closer; a hundred times is looked past.
        enough = jnp.clip(new.least, close, 100 * close)
        # In units that do not fit, a wrong X may leave little.
        unfit = apart & ~balanced
        solved = stable & (new.residual <= enough) & (~unfit | (new.given <= close))
        given = kind <= SECOND
        # Of two that are solved the one with the smaller residual is kept, and of two
        # that are not the first, unless the second alone is stable.
        take = solved & (~found.solved | (new.given < found.given))
        take = given & (take | (kind == FIRST) | stable & ~found.stable)

        def pick(now, before):
            return jnp.where(take, now, before)

        survives = stable & (new.residual <= close**0.5)
        # Rounding hides on which side of the boundary the loop is.
        undecided = ~stable & (new.gap >= -new.rounding)
        undecided &= (new.residual <= close) & new.modest
        same = jnp.abs(new.gap - found.gap) <= _ALIKE * found.gap
        found = found._replace(
            X=pick(new.X, found.X),
            residual=pick(new.residual, found.residual),
            given=pick(new.given, found.given),
            bound=pick(new.bound, found.bound),
            iterations=found.iterations + jnp.where(given, new.iterations, 0),
            solved=pick(solved, found.solved),
            gap=pick(new.gap, found.gap),
            stable=pick(stable, found.stable),
            balanced=balanced,
            fragile=jnp.where(
                kind == SHAKEN, ~(survives & same), found.fragile & ~(given & solved)
            ),
            stabilisable=jnp.where(
                kind == PLAIN,
                survives | undecided | found.stable,
                found.stabilisable,
            ),
            on_edge=jnp.where(
                kind == PLAIN,
                undecided,
                jnp.where(kind == LIFTED, survives & new.around, found.on_edge),
            ),
        )
        after_given = jnp.where(
            solved,
            jnp.where(new.near, SHAKEN, DONE),
            jnp.where(
                kind == SECOND,
                PLAIN,
                jnp.where((kind == FIRST) & apart, BALANCED, SECOND),
            ),
        )
        fragile = jnp.where(unfit, BALANCED, PLAIN)
        after_shaken = jnp.where(found.fragile, fragile, DONE)
        after_plain = jnp.where(survives & ~found.fragile, LIFTED, DONE)
        after = jnp.where(kind == PLAIN, after_plain, DONE)
        after = jnp.where(kind == SHAKEN, after_shaken, after)
        return jnp.where(given, after_given, after), found

    number = jnp.asarray(jnp.inf, dtype)
    no, yes = jnp.asarray(False), jnp.asarray(True)
    nothing = Found(
        X=X,
        residual=number,
        given=number,
        bound=number,
        iterations=jnp.asarray(0),
        solved=no,
        gap=-number,
        stable=no,
        fragile=no,
        stabilisable=yes,
        on_edge=no,
        balanced=no,
        posed=posed,
    )
    start = jnp.where(posed, FIRST, DONE)
    return lax.while_loop(more, body, (start, nothing))[1]


def verdict(found: Found) -> Result:
    """The status of what was found."""
    good = found.solved & ~found.fragile
    close = found.stable & (found.residual <= tolerance(found.X.dtype) ** 0.5)
    result = choose(close, RESULTS.not_converged, RESULTS.not_stabilising)
    result = choose(found.fragile | found.on_edge, RESULTS.on_boundary, result)
    result = choose(found.stabilisable, result, RESULTS.not_stabilisable)
    result = choose(good, RESULTS.successful, result)
    return choose(found.posed, result, RESULTS.ill_posed)


def weights(
    kind: Array, Q: Array, R: Array, S: Array
) -> tuple[Array, Array, Array, Array]:
    """The weights of the problem of this kind, and the size of the state weight."""
    n, m, dtype = Q.shape[0], R.shape[0], Q.dtype
    eps = jnp.finfo(dtype).eps
    eye_Q, eye_R = jnp.eye(n, dtype=dtype), jnp.eye(m, dtype=dtype)
    size_Q, size_R = size(Q), size(R)
    unit = jnp.where(size_R > 0, size_R, 1)
    scale = jnp.where(size_Q > 0, size_Q, unit)
    change = jnp.where(kind == SHAKEN, -10 * n * eps * size_Q, 0)
    change = jnp.where(kind == LIFTED, eps**0.5 * scale, change)
    plain = kind == PLAIN
    Q = jnp.where(plain, scale * eye_Q, Q + change * eye_Q)
    R = jnp.where(plain, unit * eye_R, R)
    return Q, R, jnp.where(plain, 0, S), scale
