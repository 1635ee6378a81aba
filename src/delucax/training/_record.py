"""The history of a training run, and the file from which it resumes."""

import tempfile
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from .._check import as_path
from .._extras import extra
from .._module import load, save, shown
from ._trainable import is_float


if TYPE_CHECKING:
    import pandas


COLUMNS = ("step", "loss", "gradient_norm", "seconds")
_FORMAT = "delucax.training.fit 2"


class History(eqx.Module):
    """The history of a training run: NumPy arrays with an entry for each step.

    `history["name"]` is the column or metric with this name, and `len(history)` is the
    number of steps.

    **Attributes:**

    - `step`: the number of the step, from 0. Its key was
        `jax.random.fold_in(key, step)`.
    - `loss`: the loss before the update.
    - `gradient_norm`: the Euclidean norm of the gradient with respect to the
        unconstrained values.
    - `seconds`: the time from the beginning of training to the end of the block that
        contains the step [s].
    - `metrics`: a dictionary of the metrics that the loss returned.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import optax

        fitted = dlx.training.fit(
            lambda model, key: (jnp.sum(model.K**2), {"largest": jnp.max(model.K)}),
            dlx.controllers.Linear(jnp.ones((1, 2))),
            optax.sgd(0.1),
            steps=10,
            key=jax.random.key(0),
        )
        fitted.history.loss[:2], fitted.history["largest"][:2]
        ```

        ```text
        (array([2.  , 1.28], dtype=float32), array([1. , 0.8], dtype=float32))
        ```
    """

    step: np.ndarray
    loss: np.ndarray
    gradient_norm: np.ndarray
    seconds: np.ndarray
    metrics: dict[str, np.ndarray]

    __repr__ = shown

    def __len__(self) -> int:
        return len(self.step)

    def __getitem__(self, name: str) -> np.ndarray:
        """The column or metric with this name.

        **Raises:** `KeyError` if there is none.
        """
        if name not in self._columns:
            names = ", ".join(self._columns)
            raise KeyError(f"History: no column {name!r}; there are {names}.")
        return self._columns[name]

    def to_pandas(self) -> "pandas.DataFrame":
        """A table with a row for each step.

        **Returns:** a `pandas.DataFrame` with the columns above and the metrics.

        **Raises:** `ImportError` without pandas (`pip install "delucax[tables]"`).
        """
        return extra("pandas", "tables").DataFrame(self._columns)

    @property
    def _columns(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in COLUMNS} | self.metrics


class Checkpoint(NamedTuple):
    """The checkpoint file of a run, and a description of the run to compare."""

    path: Path
    run: dict[str, Any]

    def resume(
        self, arrays: PyTree
    ) -> tuple[PyTree, dict[str, np.ndarray], float] | None:
        """The saved `(arrays, history, seconds)`, or `None` if there is no file.

        `arrays` are the arrays at the start of a run, for their structure.
        """
        if not self.path.exists():
            return None
        try:
            saved = load(self.path)
            if not isinstance(saved, dict) or saved.get("format") != _FORMAT:
                raise ValueError("it holds something else")
        except ValueError as error:
            raise ValueError(
                f"fit: checkpoint '{self.path}' must be a file that fit has written, "
                f"or must not exist yet. Reading it failed: {error}"
            ) from None
        for what in self.run | saved["run"]:
            old, new = saved["run"].get(what), self.run.get(what)
            if isinstance(old, tuple) and isinstance(new, tuple):
                # Three digits, so that a run may resume on another machine, where the
                # same model has slightly different numbers.
                difference = np.abs(np.subtract(old, new))
                same = np.all(difference <= 1e-3 * max(old[1], new[1]))
            else:
                same = old == new
            if not same:
                raise self._other_run(f"{what} is {old} there and {new} here")
        arrays = jax.tree.unflatten(jax.tree.structure(arrays), saved["arrays"])
        return arrays, saved["history"], saved["seconds"]

    def write(
        self, arrays: PyTree, history: dict[str, np.ndarray], seconds: float
    ) -> None:
        """Save the run. The file is replaced at once, so it is never half written."""
        # Only the leaves, because the classes of an optimiser's state may be local.
        saved = dict(arrays=jax.tree.leaves(arrays), history=history, seconds=seconds)
        save(self.path, dict(format=_FORMAT, run=self.run, **saved))

    def check_replay(
        self, saved: dict[str, np.ndarray], rows: dict[str, np.ndarray]
    ) -> None:
        """Raise unless `rows`, a repetition of the first steps, match the saved steps.

        This detects another loss, learning rate or data, which the description of the
        run does not hold.
        """
        columns = {"step", "seconds", *rows}
        if saved.keys() != columns:
            raise self._other_run(
                f"its history has {', '.join(sorted(saved))}, but this run has "
                f"{', '.join(sorted(columns))}"
            )
        for name in ("loss", "gradient_norm"):
            old, new = saved[name][: len(rows[name])], rows[name]
            if not np.allclose(old, new, rtol=1e-4, atol=0):
                raise self._other_run(
                    f"the {name} of its first steps is {old} there and {new} here, so "
                    "the loss, the optimiser or the data must be different"
                )

    def _other_run(self, difference: str) -> ValueError:
        return ValueError(
            f"fit: checkpoint '{self.path}' is of another run: {difference}. Pass "
            "another path, or delete this file."
        )


def checkpoint_path(path: Any) -> Path:
    """The checked path of a checkpoint. Makes its folder if there is none."""
    path = as_path(path, "checkpoint", "fit")
    if path.is_dir():
        raise ValueError(
            "fit: checkpoint must be the path of a file, such as "
            f"'{path / 'fit.ckpt'}', got the folder '{path}'."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ValueError(
            f"fit: checkpoint '{path}' must be in a folder that can be written to, "
            f"got: {error}."
        ) from None
    return path


def describe_run(
    model: PyTree,
    constraints: dict[str, Any],
    values: dict[str, Any],
    state: PyTree,
    memory: PyTree,
    **options: Any,
) -> dict[str, Any]:
    """The description that identifies a run. Its names are used in error messages.

    The initial arrays of the model are described by a projection and their norm.
    """
    for path, value in values.items():
        options[f"trainable {path}"] = f"{_kind(value)} {constraints.get(path, '')}"
    for name, tree in (("optimiser", state), ("memory", memory)):
        for place, leaf in _placed(tree):
            options[f"{name} {place}"] = _kind(leaf)
    for place, leaf in _placed(model):
        if is_float(leaf):
            # Bounds may be infinite.
            flat = np.nan_to_num(np.asarray(leaf, float).ravel(), posinf=1, neginf=-1)
            projection = float(flat @ np.cos(np.arange(flat.size)))
            what = f"(projection, norm) of model{place} at the start"
            options[what] = projection, float(np.linalg.norm(flat))
    return options


def _placed(tree: PyTree) -> list[tuple[str, Any]]:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in leaves]


def _kind(leaf: Any) -> str:
    return f"{leaf.dtype}{list(leaf.shape)}"
