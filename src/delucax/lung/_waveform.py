"""The target waveform of the airway pressure."""

from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import (
    check_finite,
    check_instance,
    check_number,
    check_real,
    check_step,
    is_concrete,
)
from .._message import shortened
from .._module import (
    as_float_array,
    check_parameters,
    parameter,
    parts_of,
    positive,
    shown,
)


_T = TypeVar("_T")

LENGTH = 29
"""The number of samples of an inspiration to learn from: 0.87 s."""
PIPS = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
"""The peak pressures to learn from [cmH2O]."""


class BreathWaveform(eqx.Module):
    r"""The target pressure of pressure-controlled ventilation, a function of time.

    $$r(t) = \mathrm{peep} + (\mathrm{pip} - \mathrm{peep}) \,
    \mathrm{interp}(s, \mathrm{keypoints}, \mathrm{levels}), \qquad
    s = \frac{t \bmod T}{T}, \quad T = \frac{60}{\mathrm{rate}}$$

    Here $T$ is the period of a breath [s], and $s$ is the fraction of the breath that
    has passed. The inspiratory phase is the part of the breath with
    $s \le \mathrm{inspiration}$. The keypoints are fractions of the period, so their
    times change with the rate.

    The waveform can be used like any other reference. The numbers of the waveform, such
    as `pip` and `rate`, are leaves of a pytree, so you can differentiate with respect
    to them.

    **Arguments:**

    - `pip`: the peak inspiratory pressure [cmH2O], 35 by default.
    - `peep`: the positive end-expiratory pressure [cmH2O], 5 by default. This is only
        the target. The pressure to which the lung exhales is the `peep` of its
        [`delucax.lung.Valves`][], so change both values together.
    - `rate`: breaths per minute, 20 by default.
    - `keypoints`: the times of the keypoints as fractions of a period, increasing from
        0 to 1; `(0, 1/3, 1/2, 1)` by default. The target may jump where one breath ends
        and the next breath begins.
    - `levels`: the level of the target at each keypoint, from PEEP (0) to PIP (1);
        `(1, 1, 0, 0)` by default. With the default levels, keypoints and rate, the
        target stays at PIP for 1 s and then falls to PEEP within 0.5 s.
    - `inspiration`: the fraction of a period that the inspiratory phase takes, 1/3 by
        default.

    **Raises:** `ValueError` if a number is not finite, PIP is below PEEP, the rate is
    not positive, the keypoints do not increase from 0 to 1, the numbers of keypoints
    and levels differ, or `inspiration` is not between 0 and 1.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        from delucax.lung import BreathWaveform

        waveform = BreathWaveform(pip=25.0, rate=15.0)
        waveform(0.5), waveform.is_inspiration(0.5)
        ```

        ```text
        (Array([25.], dtype=float32), Array(True, dtype=bool))
        ```
    """

    pip: Array = parameter(35.0)
    peep: Array = parameter(5.0)
    rate: Array = parameter(20.0, constraint=positive)
    keypoints: Float[Array, " points"] = parameter((0.0, 1 / 3, 1 / 2, 1.0))
    levels: Float[Array, " points"] = parameter((1.0, 1.0, 0.0, 0.0))
    inspiration: Array = parameter(1 / 3)

    __repr__ = shown

    def __check_init__(self):
        where = "BreathWaveform"
        check_parameters(self)
        for name in ("pip", "peep", "inspiration"):
            check_number(getattr(self, name), name, where)
        check_step(self.rate, where, "rate")
        keypoints, levels = self.keypoints, self.levels
        shapes = jnp.shape(keypoints), jnp.shape(levels)
        if len(shapes[0]) != 1 or shapes[0] != shapes[1] or shapes[0][0] < 2:
            raise ValueError(
                f"{where}: keypoints and levels must be vectors of one size, at least "
                f"2, got shapes {shapes[0]} and {shapes[1]}."
            )
        if is_concrete(keypoints):
            points = np.asarray(keypoints)
            if points[0] != 0 or points[-1] != 1 or not np.all(np.diff(points) > 0):
                raise ValueError(
                    f"{where}: keypoints must increase from 0 to 1, got {points}."
                )
        _check_pip(self.pip, self.peep, "pip", where)
        share = self.inspiration
        if is_concrete(share) and not 0 < float(share) < 1:
            raise ValueError(
                f"{where}: inspiration must be between 0 and 1, got {share}."
            )

    @property
    def period(self) -> Array:
        """The period of a breath [s]."""
        return 60 / self.rate

    def share(self, t: Any) -> Array:
        """The elapsed share of the breath at time `t`, from 0 to 1.

        **Arguments:** `t`: time [s].

        **Returns:** the share, of the shape of `t`. The share is 0 if rounding puts `t`
        just before the beginning of a breath.
        """
        breaths = as_float_array(t) / self.period
        # `mod` would give almost 1 if rounding puts `k dt` just before a breath.
        return jnp.maximum(breaths - jnp.floor(breaths + _slack(breaths)), 0)

    def is_inspiration(self, t: Any) -> Array:
        """Whether time `t` is in an inspiratory phase.

        **Arguments:** `t`: time [s].

        **Returns:** booleans of the shape of `t`.
        """
        slack = _slack(as_float_array(t) / self.period)
        return self.share(t) <= self.inspiration + slack

    def pressure(self, t: Any) -> Array:
        """The target pressure at time `t`.

        **Arguments:** `t`: time [s].

        **Returns:** the pressure [cmH2O], of the shape of `t`.
        """
        level = jnp.interp(self.share(t), self.keypoints, self.levels)
        return self.peep + (self.pip - self.peep) * level

    def __call__(self, t: Any) -> Array:
        """The target pressure at time `t`, shape `(1,)`."""
        return jnp.atleast_1d(self.pressure(t))

    @staticmethod
    def at_pip(tree: _T, pip: Any) -> _T:
        """Copy a pytree, and set the peak pressure of every breath waveform in it.

        An environment and its controller both hold the waveform. Under `jax.vmap` this
        makes a batch of both over several pressures, which compiles once.

        **Arguments:**

        - `tree`: a waveform, an environment, a controller, or a tuple of them.
        - `pip`: the peak inspiratory pressure [cmH2O].

        **Returns:** the copy.

        **Raises:** `ValueError` if `tree` holds no waveform, or `pip` is below PEEP.

        !!! example

            ```python
            import delucax as dlx
            from delucax.lung import BreathWaveform

            env = BreathWaveform.at_pip(dlx.make("lung/single_compartment"), 20.0)
            ```
        """
        pip = as_float_array(pip)
        if not eqx.is_inexact_array(pip):
            raise ValueError(f"at_pip: pip must be a number, got {pip!r}.")
        waveforms = lambda tree: parts_of((tree,), BreathWaveform)
        every = waveforms(tree)
        if not every:
            name = type(tree).__name__
            raise ValueError(f"at_pip: there is no BreathWaveform in the {name}.")
        for waveform in every:
            _check_pip(pip, waveform.peep, "pip", "at_pip")
        pips = lambda tree: [waveform.pip for waveform in waveforms(tree)]
        return eqx.tree_at(pips, tree, [pip] * len(every))


def _slack(breaths: Array) -> Array:
    """A bound on the rounding error of `k dt` after a number of breaths, in periods."""
    eps = jnp.finfo(breaths.dtype).eps
    return jnp.clip(2 * eps * jnp.abs(breaths), 1e-6, 1e-3)


def check_waveform(waveform: Any, where: str) -> None:
    """Raise an error unless `waveform` is a breath waveform."""
    check_instance(waveform, BreathWaveform, "waveform", where)


def as_pips(pips: Any, tree: Any, where: str) -> Array:
    """Convert `pips` to a vector of peak pressures. Raises an error if one is below the
    PEEP of a waveform in `tree`.

    This is done before `jax.vmap` maps over them, because values cannot be checked
    inside it.
    """
    array = as_float_array(pips)
    if not eqx.is_inexact_array(array) or array.ndim != 1 or not array.size:
        got = f"shape {array.shape}" if eqx.is_array(array) else shortened(pips)
        raise ValueError(f"{where}: pips must be a vector of pressures, got {got}.")
    check_real(array, "pips", where)
    for waveform in parts_of((tree,), BreathWaveform):
        if is_concrete(waveform.peep):
            _check_pip(array, np.max(np.asarray(waveform.peep)), "pips", where)
    return jnp.asarray(array, float)


def _check_pip(pip: Array, peep: Any, name: str, where: str) -> None:
    """Raise an error if a peak pressure is below PEEP and both are known."""
    check_finite(pip, name, where)
    if is_concrete(pip) and is_concrete(peep):
        if not np.all(np.asarray(pip) >= np.asarray(peep)):
            raise ValueError(
                f"{where}: {name} must be at least peep = {peep}, got {pip}."
            )
