"""Gym's arithmetic, which tasks of Gym have by default."""

import abc
import functools

import diffrax

from .._check import check_step
from .._results import Result, RESULTS
from .._typing import Control, Disturbance, State, Time
from ..dynamics import AbstractDiscretization, AbstractDynamics, Discretized


class AbstractGymStep(AbstractDiscretization):
    """A step as Gym writes it; then `w` is added."""

    @abc.abstractmethod
    def gym_step(self, x: State, u: Control) -> State:
        """The next state without disturbance.

        **Arguments:** `x`: state. `u`: control.

        **Returns:** the state, of any precision.
        """

    def advance(
        self, t: Time, x: State, u: Control, w: Disturbance
    ) -> tuple[State, Result]:
        x_next = self.gym_step(x, u)
        if w is not None:
            x_next = x_next + w
        return x_next.astype(x.dtype), RESULTS.successful


def gym_or_solver(
    step: functools.partial[AbstractDynamics],
    solver: diffrax.AbstractSolver | None,
    substeps: int,
    where: str,
) -> AbstractDynamics:
    """What `step` makes of a system, `dt` and limits, or a solver in its place."""
    system, dt = step.args
    check_step(dt, where)
    if solver is None:
        if substeps != 1:
            raise ValueError(f"{where}: substeps needs a solver, such as RK4().")
        return step()
    for name in step.keywords:
        raise ValueError(
            f"{where}: {name} is of Gym's arithmetic, and no solver has the like; give "
            f"one of {name} and solver."
        )
    return Discretized(system, dt, solver, substeps)
