"""Problems over a fixed interval: catalyst mixing and the hanging chain."""

import jax.numpy as jnp

from .._check import check_count
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time
from ..dynamics import Discretized
from ..planning import Constraints
from ..systems import AbstractSystem
from ._base import FinalState, line, OptimalControl, Reach


class CatalystMixing(AbstractSystem):
    r"""A tubular reactor with two catalysts, whose mixture $u$ varies along the tube.

    $$\dot x_1 = u (k x_2 - x_1), \qquad
    \dot x_2 = u (x_1 - k x_2) - (1 - u) x_2$$

    **Arguments:** `rate`: $k$, 10 by default.

    Source: von Stryk, 1999; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.CatalystMixing(rate=9.0)
        ```

        ```text
        CatalystMixing(rate=9.0)
        ```
    """

    rate: Real = parameter(10.0, constraint=positive)

    state_names, control_names = ("x_1", "x_2"), ("mixture",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        back = u[0] * (self.rate * x[1] - x[0])
        return jnp.stack([back, -back - (1 - u[0]) * x[1]])


def catalyst_mixing(steps: int = 100) -> OptimalControl:
    r"""Mix two catalysts along a tube such that as much product as possible leaves it.

    The problem is to minimise the final cost $-1 + x_1 + x_2$ at time 1. The first
    state is $(1, 0)$, and the bounds are $0 \le u \le 1$. The published minimum is
    -0.0480556. The first guess is the constant mixture $u = 0.5$.

    **Arguments:** `steps`: T, the number of steps, 100 by default.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: von Stryk, 1999; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.catalyst_mixing().bounds
        ```

        ```text
        (0.0, 1.0)
        ```
    """
    T = check_count(steps, "steps", "catalyst_mixing")
    return OptimalControl(
        Discretized(CatalystMixing(), 1.0 / T),
        FinalState(jnp.ones(2), -1.0),
        jnp.array([1.0, 0.0]),
        jnp.full((T, 1), 0.5),
        -0.0480556,
        bounds=(0.0, 1.0),
    )


class HangingChain(AbstractSystem):
    r"""A hanging chain, with the states height $h$, length $s$ and potential energy
    $e$.

    $$\dot h = u, \qquad \dot s = \sqrt{1 + u^2}, \qquad \dot e = h \sqrt{1 + u^2}$$

    The independent variable is the horizontal position. The control $u$ is the slope of
    the chain.

    Source: Cesari, 1983; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.HangingChain()
        ```

        ```text
        HangingChain()
        ```
    """

    state_names, control_names = ("height", "length", "energy"), ("slope",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        length = jnp.sqrt(1 + u[0] ** 2)
        return jnp.stack([u[0], length, x[0] * length])


def hanging_chain(steps: int = 100) -> OptimalControl:
    r"""Find the shape of a hanging chain: the shape with the least potential energy.

    The chain has length 4. Its ends are at height 1 (position 0) and at height 3
    (position 1). The minimum energy is 5.06848, the energy of the catenary. `reference`
    is the published value, 5.06891. The first guess is a straight line between the
    ends.

    **Arguments:** `steps`: T, the number of steps, 100 by default.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Cesari, 1983; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.hanging_chain().states[-1]
        ```

        ```text
        Array([3., 4., 8.], dtype=float32)
        ```
    """
    T = check_count(steps, "steps", "hanging_chain")
    begin = [1.0, 0.0, 0.0]
    return OptimalControl(
        Discretized(HangingChain(), 1.0 / T),
        FinalState(jnp.array([0.0, 0.0, 1.0])),
        jnp.array(begin),
        jnp.full((T, 1), 2.0),
        5.06891,
        line(begin, [3.0, 4.0, 8.0], T),
        constraints=Constraints(final_equality=Reach(jnp.array([3.0, 4.0]), (0, 1))),
    )
