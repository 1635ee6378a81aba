"""Guesses of the active sides, before the interior-point method.

With the active sides given, a program is one linear system, that of a step of the
method. Its solution says which sides it violates and which do not push: the next guess.
Programs of control end after a few, from the active sides of a program before or from
none; there is no proof that they do, so the number of guesses is bounded.

Source: Hintermueller, Ito and Kunisch, 2002 (primal-dual active sets).
"""

from typing import NamedTuple

import jax.numpy as jnp

from .._typing import Array
from ._embedding import Iterate, Method
from ._form import both, Sides


GUESSES = 10
"""So many sets are tried at most."""
PASSES = 3
"""Each linear system is solved and refined so many times."""


class Guess(NamedTuple):
    """Which sides are taken to be active."""

    held: Array  # with equality
    over: Array  # violated, a soft side
    left: Array  # so many guesses are left

    def sides(self, sides: Sides) -> tuple[Sides, Array]:
        """The sides of the equations that then hold, and the compliance of each: that
        of the weight of a violation."""
        spring = self.over & (sides.W > 0)
        compliance = jnp.where(spring, 1 / jnp.where(spring, sides.W, 1), 0)
        held = sides.equality | self.held
        return sides._replace(inequality=spring, equality=held), compliance

    def pushed(self, sides: Sides) -> Array:
        """The multipliers of the sides whose violation has a linear weight alone."""
        return jnp.where(self.over & (sides.W == 0), sides.v, 0)


def active_at(method: Method, at: Iterate) -> Guess:
    """The sides that are active at a point of the method."""
    _, _, z, s, t, m = method.apart(at.v)
    active = method.sides.inequality & (z > s)
    over = active & method.sides.soft & (t > m)
    return Guess(active & ~over, over, jnp.asarray(1))


def tried(method: Method, along: Array, guess: Guess) -> tuple[Iterate, Guess]:
    """The point at which the active sides are as guessed, and the next guess."""
    sides = method.sides
    x, p, z, *_ = method.apart(along)
    z = z + guess.pushed(sides)
    over = both(method.scaled.rows(x)) - sides.h
    on, one = sides.inequality, jnp.ones((), along.dtype)
    too_far = sides.soft & (z > sides.v) & guess.held
    stays = jnp.where(guess.over, over > 0, False)
    held = jnp.where(guess.held, (z > 0) & ~too_far, over > 0) & on
    # A violated side that is met again is held.
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
