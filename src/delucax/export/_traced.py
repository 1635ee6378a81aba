"""A controller as two programs of arrays: its step, and its `applied`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._controller import AbstractController, initial_state
from ._cast import cast, precision
from ._keys import as_keys, as_words, is_key, is_ours
from ._refusal import Unsupported
from ._trace import trace


_MOST_TRIED = 16


class TracedController:
    """The programs of a controller.

    - `step`, `applied`: the blocks of `__call__` and `applied`. The arrays of the state
        are further inputs and outputs.
    - `start`: the arrays of the first state.
    - `paths`: the places of these arrays in the state.
    - `observations`: the size of an observation.
    - `controls`: the shape of a control.
    """

    def __init__(
        self,
        controller: Any,
        dtype: np.dtype,
        example: Any,
        key: Any,
        size: int | None = None,
    ):
        self.dtype = dtype
        with precision(dtype):
            controller = cast(controller, dtype)
            start = _first_state(controller, dtype, key)
            arrays, static = eqx.partition(start, eqx.is_array)
            leaves, structure = jax.tree_util.tree_flatten_with_path(arrays)
            # C has no arrays without entries.
            kept = [bool(leaf.size) for _, leaf in leaves]
            full = [pair for pair in leaves if pair[1].size]
            self.start = [np.asarray(as_words(leaf)) for _, leaf in full]
            self.paths = [jax.tree_util.keystr(path) for path, _ in full]
            kinds = [(leaf.shape, leaf.dtype) for _, leaf in leaves]

            def unflatten(flat):
                rest = iter(flat)
                pairs = zip(leaves, kept, strict=True)
                every = [
                    as_keys(next(rest), leaf.dtype) if used else leaf
                    for (_, leaf), used in pairs
                ]
                return eqx.combine(jax.tree.unflatten(structure, every), static)

            def flatten(state):
                changing, rest = eqx.partition(state, eqx.is_array)
                flat, after = jax.tree.flatten(changing)
                # Compare kinds: a leaf may have the precision of this process.
                alike = after == structure and all(
                    leaf.shape == shape
                    and (is_key(kind) or leaf.dtype.kind == kind.kind)
                    for leaf, (shape, kind) in zip(flat, kinds, strict=True)
                )
                if not alike or not eqx.tree_equal(rest, static):
                    raise Unsupported(
                        f"{_UNLIKE}, {eqx.tree_pformat(start)}, got "
                        f"{eqx.tree_pformat(state)}. What changes must be a JAX array "
                        "from init on."
                    )
                return [
                    jnp.asarray(as_words(leaf), None if is_key(kind) else kind)
                    for leaf, (_, kind), used in zip(flat, kinds, kept, strict=True)
                    if used
                ]

            def step(t, y, *flat):
                u, after = controller(t, y, unflatten(flat))
                return [_control(u, dtype), *flatten(after)]

            def applied(u, cost, *flat):
                return flatten(controller.applied(u, cost, unflatten(flat)))

            number = jax.ShapeDtypeStruct((), dtype)
            state = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in self.start]
            y = _observation(step, number, state, dtype, example, size)
            self.step = trace(step, number, y, *state, draws=True)
            self.observations, self.controls = y.shape[0], self.step.outs[0].shape
            u = jax.ShapeDtypeStruct(self.controls, dtype)
            self.applied = trace(applied, u, number, *state, draws=True)


_UNLIKE = "export.c: the controller must return a state like that of init"


def _control(u: Any, dtype: np.dtype) -> Any:
    if jnp.ndim(u) != 1 or not jnp.size(u):
        raise Unsupported(
            "export.c: the controller must return a control of shape (m,), got shape "
            f"{jnp.shape(u)}."
        )
    return jnp.asarray(u, dtype)


def _first_state(controller: AbstractController, dtype: np.dtype, key: Any) -> Any:
    try:
        state = initial_state(controller, key)
    except ValueError as error:
        if key is not None or "key" not in str(error):
            raise
        raise Unsupported(
            f"export.c: {type(controller).__name__} cannot be exported without key=, "
            f"such as jax.random.key(0), because it draws random numbers ({error})"
        ) from error
    for leaf in jax.tree.leaves(eqx.filter(state, eqx.is_array)):
        if is_key(leaf.dtype) and not is_ours(leaf.dtype):
            raise Unsupported(
                f"export.c: {type(controller).__name__} cannot be exported: it draws "
                f"with a {leaf.dtype}, and C draws with threefry2x32 only."
            )
    return cast(state, dtype)


def _observation(
    step: Any, number: Any, state: Any, dtype: np.dtype, example: Any, size: int | None
) -> Any:
    """The shape of an observation: as in the example, else the only size that fits,
    else the `size` of the plant's observation."""
    if example is not None:
        y = np.asarray(example) if not hasattr(example, "shape") else example
        if len(y.shape) != 1:
            raise ValueError(
                "export.c: example must be an observation of a controller, a vector, "
                f"got shape {tuple(y.shape)}."
            )
        return jax.ShapeDtypeStruct(tuple(y.shape), dtype)
    fitting = []
    for tried in range(1, _MOST_TRIED + 1):
        y = jax.ShapeDtypeStruct((tried,), dtype)
        try:
            jax.eval_shape(step, number, y, *state)
        except Exception:  # noqa: BLE001 - a controller may raise anything
            continue
        fitting.append(y)
        if len(fitting) > 1:
            break
    if len(fitting) == 1:
        return fitting[0]
    if size is not None:
        return jax.ShapeDtypeStruct((size,), dtype)
    raise ValueError(
        "export.c: the size of the observation is not known from this controller. Pass "
        "plant=env.dynamics, or example=jnp.zeros(n) for n observations."
    )
