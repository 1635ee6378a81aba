"""Guesses of the active sides, before the interior-point method.

If the active sides are known, a program is one linear system, of the same form as in a
step of the method. Its solution shows which other sides it violates and which active
sides have a negative multiplier. This gives the next guess. Programs of control need
only a few guesses, from the active sides of a previous program or from none. There is
no proof of this, so the number of guesses is limited.

Source: Hintermueller, Ito and Kunisch, 2002 (primal-dual active sets).
"""

from typing import NamedTuple

import jax.numpy as jnp

from .._typing import Array
from ._embedding import Iterate, Method
from ._form import both, Sides


GUESSES = 10
"""The largest number of guesses."""
PASSES = 3
"""The number of solves of each linear system, with its refinements."""


class Guess(NamedTuple):
    """A guess of the active sides."""

    held: Array  # sides that hold with equality
    over: Array  # soft sides that are violated
    left: Array  # the number of guesses that are left

    def sides(self, sides: Sides) -> tuple[Sides, Array]:
        """The sides that the guess makes equations, and the compliance of each side.

        The compliance is the inverse of the quadratic weight of a violated side.
        """
        spring = self.over & (sides.W > 0)
        compliance = jnp.where(spring, 1 / jnp.where(spring, sides.W, 1), 0)
        held = sides.equality | self.held
        return sides._replace(inequality=spring, equality=held), compliance

    def pushed(self, sides: Sides) -> Array:
        """The multipliers of the violated sides that have only a linear weight."""
        return jnp.where(self.over & (sides.W == 0), sides.v, 0)


def active_at(method: Method, at: Iterate) -> Guess:
    """The sides that are active at a point of the method."""
    _, _, z, s, t, m = method.apart(at.v)
    active = method.sides.inequality & (z > s)
    over = active & method.sides.soft & (t > m)
    return Guess(active & ~over, over, jnp.asarray(1))


def tried(method: Method, along: Array, guess: Guess) -> tuple[Iterate, Guess]:
    """The point for a guess of the active sides, and the next guess."""
    sides = method.sides
    x, p, z, *_ = method.apart(along)
    z = z + guess.pushed(sides)
    over = both(method.scaled.rows(x)) - sides.h
    on, one = sides.inequality, jnp.ones((), along.dtype)
    too_far = sides.soft & (z > sides.v) & guess.held
    stays = jnp.where(guess.over, over > 0, False)
    held = jnp.where(guess.held, (z > 0) & ~too_far, over > 0) & on
    # A soft side that is not violated any more is held at its bound.
    held = jnp.where(guess.over, ~stays, held)
    violated = too_far | stays
    t = jnp.where(guess.over, jnp.maximum(over, 0), 0)
    s = jnp.where(on, jnp.maximum(t - over, 0), 0)
    z = jnp.where(on, jnp.maximum(z, 0), jnp.where(sides.equality, z, 0))
    m = jnp.where(sides.hinge, jnp.maximum(sides.v + sides.W * t - z, 0), 0)
    same = jnp.all(held == guess.held) & jnp.all(violated == guess.over)
    left = jnp.where(same, 0, guess.left - 1)
    at = Iterate(method.joined(x, p, z, s, t, m), one, one)
    return at, Guess(held, violated, left)
