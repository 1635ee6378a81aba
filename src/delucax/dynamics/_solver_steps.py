"""The vector field within a control interval, and single steps of Diffrax solvers."""

from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array

from .._integration import evaluate_field, solve_result, throwing_adjoint
from .._results import choose, promote, Result, RESULTS


def apply(g: Array, dB: Array) -> Array:
    return g * dB if g.ndim == 1 else g @ dB


class BrownianTerm(diffrax.AbstractTerm):
    """`g dB` with a given increment. Diffrax's own term would evaluate a path; here
    increments are data, which you can record and differentiate."""

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
    """The vector field at the time `s` after the start of the interval. Not a closure,
    because Diffrax's adjoints differentiate with respect to `args` only.
    """
    system, start, u, held = args
    return start.evaluate(s, lambda t: evaluate_field(system, t, x, u, held))


def solver_step(solver, term, s, x, h, args):
    """One Diffrax step of length `h` from the time `s` after the start of the interval.
    The solver is initialised anew, because the control may have switched.
    """
    # In local time, so that t1 - t0 is accurate in a late interval too.
    t0 = jnp.asarray(s, x.dtype)
    t1 = t0 + h
    state = solver.init(term, t0, t1, x, args)
    x_next, _, _, _, result = solver.step(
        term, t0, t1, x, args, state, made_jump=jnp.array(True)
    )
    if result is diffrax.RESULTS.successful:
        return x_next, RESULTS.successful
    # Replaced, because Diffrax's message advises about a step-size controller.
    solved = promote(result) == RESULTS.successful
    return x_next, choose(solved, RESULTS.successful, RESULTS.stage_not_solved)


def adaptive_solve(
    s: Array,
    x: Array,
    end: Array,
    args: Any,
    every_step: bool,
    adjoint: Any,
    method: dict[str, Any],
) -> tuple[diffrax.Solution, Result]:
    """A solve with adaptive steps from `x` at `s` to `end`, and its result. `method`
    holds the solver, the step-size controller and the largest number of steps."""
    saved: Any = dict(t1=True)
    if every_step:
        steps = diffrax.SubSaveAt(t0=True, steps=True)
        saved = dict(subs=[diffrax.SubSaveAt(t1=True), steps])
    # No `dt0`: Diffrax estimates the first step from the field (Hairer, Nørsett and
    # Wanner, 1993, II.4). The last step of the previous interval would be a poor guess,
    # because it was cut off at the end. No `throw`: one failing member of a batch must
    # not stop the others.
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        t0=s,
        t1=end,
        dt0=None,
        y0=x,
        args=args,
        saveat=diffrax.SaveAt(**saved),
        adjoint=throwing_adjoint(adjoint),
        throw=False,
        **method,
    )
    return solution, solve_result(solution, method["stepsize_controller"], x.dtype)
