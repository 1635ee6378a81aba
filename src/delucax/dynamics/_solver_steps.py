"""The field of an interval, and steps of Diffrax solvers in it."""

from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array

from .._integration import evaluate_field
from .._results import choose, promote, RESULTS


def apply(g: Array, dB: Array) -> Array:
    return g * dB if g.ndim == 1 else g @ dB


class BrownianTerm(diffrax.AbstractTerm):
    """`g dB` with the increment of this step given, where Diffrax's own term would
    evaluate a path: increments are data here, to be given, kept and differentiated."""

    diffusion: Any
    increment: Array

    def vf(self, t, y, args):
        del args
        return self.diffusion(t, y)

    def contr(self, t0, t1, **kwargs):
        del t0, t1, kwargs
        return self.increment

    def prod(self, vf, control):
        return apply(vf, control)


def field(s, x, args):
    """The vector field at `s` after the start of the interval. Adjoints differentiate
    `args` only, not closures.
    """
    system, start, u, held = args
    return start.evaluate(s, lambda t: evaluate_field(system, t, x, u, held))


def solver_step(solver, term, s, x, h, args):
    """One Diffrax step of `h` from `s` after the start of the interval. It starts
    afresh, as it must after a switch of the control.
    """
    # In local time, so that t1 - t0 is h to rounding, however late the interval is.
    t0 = jnp.asarray(s, x.dtype)
    t1 = t0 + h
    state = solver.init(term, t0, t1, x, args)
    x_next, _, _, _, result = solver.step(
        term, t0, t1, x, args, state, made_jump=jnp.array(True)
    )
    if result is diffrax.RESULTS.successful:
        return x_next, RESULTS.successful
    # Diffrax's message refers to a step-size controller, which there is not.
    solved = promote(result) == RESULTS.successful
    return x_next, choose(solved, RESULTS.successful, RESULTS.stage_not_solved)
