"""A training run on disk, written so that it is either whole or the one before."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._check import as_path
from ._trainable import is_float


_FORMAT = "delucax.training.fit 1"


class Checkpoint(NamedTuple):
    """Where a run is kept, and what tells it from others."""

    path: Path
    run: dict[str, Any]

    def resume(
        self, arrays: Any, where: str
    ) -> tuple[Any, dict[str, np.ndarray], float] | None:
        """`(arrays, history, seconds)` as they were written; `None` if none were.

        `arrays` are those at the start of the run, for their structure.
        """
        if not self.path.exists():
            return None
        header = _header(self.path, where)
        _check_same_run(self.path, header["run"], self.run, where)
        rows = {
            name: np.zeros(header["step"], dtype)
            for name, dtype in header["history"].items()
        }
        try:
            with open(self.path, "rb") as file:
                file.readline()
                like = (_without_keys(arrays), rows)
                plain, rows = eqx.tree_deserialise_leaves(file, like)
        except Exception as error:
            raise ValueError(
                f"{where}: checkpoint '{self.path}' must be whole, but could not be "
                f"read: {error}"
            ) from None
        return _with_keys(plain, arrays), rows, header["seconds"]

    def write(self, arrays: Any, rows: dict[str, np.ndarray], seconds: float) -> None:
        """Write the run beside the old file, and put it in its place at once."""
        header = {
            "format": _FORMAT,
            "run": self.run,
            "step": len(rows["step"]),
            "seconds": seconds,
            "history": {name: str(column.dtype) for name, column in rows.items()},
        }
        beside = self.path.with_name(self.path.name + ".tmp")
        with open(beside, "wb") as file:
            file.write(json.dumps(header).encode() + b"\n")
            eqx.tree_serialise_leaves(file, (_without_keys(arrays), rows))
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, self.path)


def prepare(path: Any, where: str) -> Path:
    """The path of a checkpoint, in a folder that is there and can be written to."""
    path = as_path(path, "checkpoint", where)
    if path.is_dir():
        raise ValueError(
            f"{where}: checkpoint must be the path of a file, such as "
            f"'{path / 'fit.ckpt'}', got the folder '{path}'."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ValueError(
            f"{where}: checkpoint '{path}' must be in a folder that can be written to, "
            f"got: {error}."
        ) from None
    return path


def describe(tree: Any) -> dict[str, str]:
    """The kind of each array of a tree, by its place."""
    return {
        jax.tree_util.keystr(path): f"{leaf.dtype}{list(leaf.shape)}"
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def fingerprint(tree: Any) -> dict[str, list[float]]:
    """Two numbers of each floating-point array that tell other values from these.

    They are compared to three digits, so that a run may go on on another machine,
    where the same model comes out a little different.
    """
    marks = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if is_float(leaf):
            # Bounds may be infinite, and JSON has no word for that.
            values = np.nan_to_num(np.asarray(leaf, float).ravel(), posinf=1, neginf=-1)
            pattern = np.cos(np.arange(values.size))
            size = float(np.linalg.norm(values))
            marks[jax.tree_util.keystr(path)] = [float(values @ pattern), size]
    return marks


def _header(path: Path, where: str) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            header = json.loads(file.readline())
        if header["format"] == _FORMAT:
            return header
    except (ValueError, KeyError, TypeError):
        pass
    raise ValueError(
        f"{where}: checkpoint '{path}' must be a file that fit has written, or not be "
        "there."
    )


def check_replay(
    path: Any,
    there: dict[str, np.ndarray],
    here: dict[str, np.ndarray],
    count: int,
    where: str,
) -> None:
    """Raise unless the first steps, taken again, are those that were written.

    A loss, a learning rate and the contents of data have no name to be compared by, but
    all show there.
    """
    made = {"step", "seconds", *here}
    if there.keys() != made:
        raise ValueError(
            f"{where}: checkpoint '{path}' is of another run: its history has "
            f"{', '.join(sorted(there))}, and the loss makes "
            f"{', '.join(sorted(made))}. Name another file, or delete this one."
        )
    for name in ("loss", "gradient_norm"):
        old, new = there[name][:count], here[name][:count]
        if not np.allclose(old, new, rtol=1e-4, atol=0):
            raise ValueError(
                f"{where}: checkpoint '{path}' is of another run: the {name} of its "
                f"first steps is {old} and is {new} here, so that the loss, the "
                "optimiser or the data must be others. Name another file, or delete "
                "this one."
            )


def _check_same_run(
    path: Path, there: dict[str, Any], here: dict[str, Any], where: str
) -> None:
    """Raise unless a checkpoint is of the run that asks for it."""

    def differ(what, old, new):
        raise ValueError(
            f"{where}: checkpoint '{path}' is of another run: {what} is {old} there "
            f"and {new} here. Name another file, or delete this one."
        )

    for what in ("steps", "key", "batch_size", "data_size"):
        if there[what] != here[what]:
            differ(what, there[what], here[what])
    for what in ("trainable", "optimiser"):
        old, new = there[what], here[what]
        for place in sorted(old.keys() | new.keys()):
            if old.get(place) != new.get(place):
                differ(f"{what} {place}", old.get(place), new.get(place))
    for place in sorted(there["start"].keys() | here["start"].keys()):
        old, new = there["start"].get(place), here["start"].get(place)
        if old is None or new is None or not _are_close(old, new):
            what = f"(projection, norm) of model{place} at the start"
            differ(what, old, new)


def _are_close(old: list[float], new: list[float]) -> bool:
    return bool(np.all(np.abs(np.subtract(old, new)) <= 1e-3 * max(old[1], new[1])))


def _is_key(leaf: Any) -> bool:
    return eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _without_keys(tree: Any) -> Any:
    """Typed random keys cannot be written; their data can."""
    return jax.tree.map(lambda leaf: jr.key_data(leaf) if _is_key(leaf) else leaf, tree)


def _with_keys(plain: Any, like: Any) -> Any:
    return jax.tree.map(
        lambda leaf, old: (
            jr.wrap_key_data(leaf, impl=jr.key_impl(old)) if _is_key(old) else leaf
        ),
        plain,
        like,
    )
