"""Domain randomisation: parameters drawn at random."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._check import check_key, is_concrete
from .._message import shortened
from .._module import as_float_array, check_paths, get_path, replace
from .._typing import PRNGKey


def randomise(tree: Any, key: PRNGKey, ranges: dict[str, Any]) -> Any:
    """Domain randomisation: a copy of an environment with some parameters drawn at
    random.

    To make a batch of plants with one compilation, use `jax.vmap` over keys. Values
    that are drawn under `jax.vmap` or `jax.jit` cannot be checked. Therefore
    `randomise` checks the ends of the ranges instead. It checks each end of a range
    twice: with all other parameters at their lower ends, and with all of them at their
    upper ends. If a range is a function, the drawn values are checked only outside of
    `jax.vmap` and `jax.jit`.

    **Arguments:**

    - `tree`: an environment, or anything else that [`delucax.replace`][] takes.
    - `key`: a random key.
    - `ranges`: a dictionary from paths, such as `"dynamics.system.length"`, to ranges.
        A range is a pair `(low, high)`, from which values are drawn uniformly, or a
        function that takes a random key and returns a value.

    **Returns:** the copy.

    **Raises:** `ValueError` if a path does not exist or is part of another path, if a
    range is neither a pair of finite numbers nor a function, or if a range holds values
    that are not valid.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        ranges = {"dynamics.system.length": (0.8, 1.2)}

        def cost(key):
            plant_key, key = jax.random.split(key)
            plant = dlx.randomise(env, plant_key, ranges)
            zero = dlx.controllers.Zero(1)
            return dlx.rollout(plant, zero, key=key, x0=[0.1, 0.0]).total_cost

        costs = jax.jit(jax.vmap(cost))(jax.random.split(jax.random.key(0), 8))
        costs.shape
        ```

        ```text
        (8,)
        ```
    """
    check_key(key, "randomise")
    if not isinstance(ranges, Mapping):
        raise ValueError(
            "randomise: ranges must be a dictionary from paths to ranges, such as "
            f"{{'dynamics.system.length': (0.8, 1.2)}}, got {ranges!r}."
        )
    check_paths(ranges, "randomise")
    changes, ends, keys = {}, {}, jr.split(key, len(ranges))
    for (path, given), one in zip(ranges.items(), keys, strict=True):
        old = get_path(tree, path)
        if callable(given):
            changes[path] = given(one)
        elif isinstance(given, tuple | list) and len(given) == 2:
            with jax.ensure_compile_time_eval():  # so that jit does not hide numbers
                low, high = (as_float_array(end) for end in given)
            if not (eqx.is_inexact_array(low) and eqx.is_inexact_array(high)):
                raise ValueError(
                    f"randomise: the range of {path!r} must hold numbers, got "
                    f"{shortened(given)}."
                )
            shape: Any = jnp.broadcast_shapes(jnp.shape(old), low.shape, high.shape)
            dtype = jnp.result_type(old, low, high)
            if is_concrete(low) and is_concrete(high):
                least, most = np.asarray(low, dtype), np.asarray(high, dtype)
                if not np.all((least <= most) & np.isfinite(most - least)):
                    raise ValueError(
                        f"randomise: the range of {path!r} must be finite and have "
                        f"low <= high, got {shortened(given)}."
                    )
                ends[path] = _inner_ends(least, most, shape)
            unit = jr.uniform(one, shape, dtype)
            changes[path] = low + (high - low) * unit
        else:
            raise ValueError(
                f"randomise: the range of {path!r} must be a pair (low, high) or a "
                f"function of a key, got {shortened(given)}."
            )
    _check_ends(tree, changes, ends)
    return replace(tree, changes)


def _inner_ends(low: Any, high: Any, shape: tuple[int, ...]) -> tuple[Any, Any]:
    """The ends of a range, moved inside by a rounding. An open interval may then be
    given by its end points, such as 0 for a positive parameter."""
    small = np.finfo(low.dtype).eps * (high - low)
    first = np.maximum(np.nextafter(low, high), low + small)
    last = np.minimum(np.nextafter(high, low), high - small)
    return np.broadcast_to(first, shape), np.broadcast_to(last, shape)


def _check_ends(tree: Any, changes: dict[str, Any], ends: dict[str, Any]) -> None:
    """Raise if a range holds invalid values, because traced draws cannot be checked.

    All values are set to the same end of their ranges, or all but one. Each of these
    combinations may be drawn, so no valid ranges are refused.
    """
    count = len(ends)
    sides = {
        tuple(side ^ (k == odd) for k in range(count))
        for side in (False, True)
        for odd in range(-1, count)
    }
    for corner in sorted(sides) if ends else ():
        tried = {path: ends[path][at] for path, at in zip(ends, corner, strict=True)}
        try:
            with jax.ensure_compile_time_eval():
                replace(tree, changes | tried)
        except ValueError as error:
            raise ValueError(
                f"{error} It is within the ranges of randomise. Narrow them."
            ) from error
