"""The record of a training run."""

from typing import Any, TYPE_CHECKING

import equinox as eqx
import numpy as np

from .._extras import extra


if TYPE_CHECKING:
    import pandas


COLUMNS = ("step", "loss", "gradient_norm", "seconds")


class History(eqx.Module):
    """What was measured at each step, in NumPy arrays of one entry a step.

    **Attributes:**

    - `step`: the step, counted from 0; its key is `jax.random.fold_in(key, step)`.
    - `loss`: the loss before the step was taken.
    - `gradient_norm`: the Euclidean norm of its gradient, in unconstrained values.
    - `seconds`: the time since training began, read at the end of the step's block.
    - `metrics`: a dictionary of what else the loss returned.

    `history["name"]` is a column or a metric, and `len(history)` the number of steps.

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
        fitted.history.loss[-1], fitted.history["largest"]
        ```
    """

    step: np.ndarray
    loss: np.ndarray
    gradient_norm: np.ndarray
    seconds: np.ndarray
    metrics: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.step)

    def __getitem__(self, name: str) -> np.ndarray:
        """The column or metric of that name.

        **Raises:** `KeyError` if there is no such column.
        """
        if name in COLUMNS:
            return getattr(self, name)
        if name in self.metrics:
            return self.metrics[name]
        raise KeyError(
            f"History: no column {name!r}; there are "
            f"{', '.join((*COLUMNS, *self.metrics))}."
        )

    def to_pandas(self) -> "pandas.DataFrame":
        """A table with a row for each step.

        **Returns:** a `pandas.DataFrame`, its columns those above and the metrics.

        **Raises:** `ImportError` without pandas (`pip install "delucax[tables]"`).
        """
        pd = extra("pandas", "tables")

        return pd.DataFrame({name: self[name] for name in (*COLUMNS, *self.metrics)})


def history_of(columns: dict[str, Any]) -> History:
    """A history of its columns by name."""
    columns = {name: np.asarray(column) for name, column in columns.items()}
    metrics = {name: c for name, c in columns.items() if name not in COLUMNS}
    return History(**{name: columns[name] for name in COLUMNS}, metrics=metrics)
