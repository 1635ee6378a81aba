"""The time budget of a search."""

import time


# Training ends at the first share of the budget, because the rest is for the
# comparison. If there will be no time for a comparison, it ends at the second. The
# final choice may take the third.
_TRAINING, _ALONE, _CHOOSING = 0.7, 0.9, 0.05
# A comparison starts only if it is likely to end within `_OVERRUN` times the budget. It
# is expected to take so many times as long as the longest step so far, because plans,
# and MPC even more, take longer to compile than a training.
_OVERRUN, _LONGER = 1.1, {"MPC": 2.0, "plan": 1.5}
# Derivatives compile longer than a rollout alone. So before the first derivative (with
# events evolution comes first) a gradient is expected to take so many times as long as
# the longest step, and a comparison so many times as long as above.
_GRADIENT, _DERIVATIVES = 1.5, 2.0


class Budget:
    """The time of a search, in seconds: how much is spent, and what the rest is enough
    for. Most steps of a search take as long as their compilation, so the longest so far
    tells about how long the next one will take."""

    def __init__(self, total: float):
        self.total, self.began = total, time.perf_counter()
        # The longest step so far: a first round, which compiles, or a comparison.
        self.longest = 0.0
        # Whether one of these steps compiled a derivative.
        self.differentiated = False

    @property
    def spent(self) -> float:
        """The time since the search began."""
        return time.perf_counter() - self.began

    @property
    def left(self) -> float:
        """The time that is left."""
        return max(0.0, self.total - self.spent)

    @property
    def is_over(self) -> bool:
        """Whether not even a comparison may go on."""
        return self.spent > _OVERRUN * self.total

    def add_step(self, seconds: float, differentiates: bool) -> None:
        """Tell how long a step took, and whether its program has a derivative."""
        self.longest = max(self.longest, seconds)
        self.differentiated |= differentiates

    @property
    def training_ends(self) -> float:
        """The time at which the training ends."""
        ends, choice = _TRAINING * self.total, _CHOOSING * self.total
        # MPC takes longer, so if there is no time for plans, there is none for MPC.
        compares = self.may_compare("plan", ends + choice)
        return ends if compares else _ALONE * self.total

    @property
    def choice_ends(self) -> float:
        """The time at which the final choice ends."""
        return self.training_ends + _CHOOSING * self.total

    @property
    def may_train(self) -> bool:
        """Whether there is time to train."""
        return self.spent < self.training_ends

    def may_compile(self, differentiates: bool) -> bool:
        """Whether there is time to train by a program that is not compiled yet."""
        first = differentiates and not self.differentiated
        expected = self.longest * (_GRADIENT if first else 1.0)
        return self.may_train and self.spent + expected < self.total

    def may_compare(self, name: str, at: float) -> bool:
        """Whether there is time for a comparison with this controller from then on."""
        factor = _LONGER[name] * (1.0 if self.differentiated else _DERIVATIVES)
        return at + factor * self.longest < _OVERRUN * self.total
