"""A training run on disk, written so that it is either whole or the one before."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np


_FORMAT = "delucax.training.fit"


def prepare(path: Any, where: str) -> Path:
    """The path of a checkpoint, in a folder that is there and can be written to."""
    path = Path(path)
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


def write(path: Path, run: dict[str, Any], progress: dict[str, Any], tree: Any) -> None:
    """Write a checkpoint beside the old one, and put it in its place at once."""
    header = {"format": _FORMAT, "version": 1, "run": run, "progress": progress}
    beside = path.with_name(path.name + ".tmp")
    with open(beside, "wb") as file:
        file.write(json.dumps(header).encode() + b"\n")
        eqx.tree_serialise_leaves(file, _without_keys(tree))
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)


def read_header(path: Path, where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """`(run, progress)` of a checkpoint."""
    try:
        with open(path, "rb") as file:
            header = json.loads(file.readline())
        if header["format"] != _FORMAT or header["version"] != 1:
            raise ValueError
        return header["run"], header["progress"]
    except (ValueError, KeyError, TypeError):
        raise ValueError(
            f"{where}: checkpoint '{path}' must be a file that fit has written, or not "
            "be there."
        ) from None


def read(path: Path, like: Any, where: str) -> Any:
    """The arrays of a checkpoint, in the structure of `like`."""
    try:
        with open(path, "rb") as file:
            file.readline()
            plain = eqx.tree_deserialise_leaves(file, _without_keys(like))
    except Exception as error:
        raise ValueError(
            f"{where}: checkpoint '{path}' must be whole, but reading it failed: {error}"
        ) from None
    return jax.tree.map(
        lambda leaf, old: jr.wrap_key_data(leaf, impl=jr.key_impl(old))
        if _is_key(old)
        else leaf,
        plain,
        like,
    )


def _is_key(leaf: Any) -> bool:
    return eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _without_keys(tree: Any) -> Any:
    """Typed random keys cannot be written; their data can."""
    return jax.tree.map(
        lambda leaf: jr.key_data(leaf) if _is_key(leaf) else leaf, tree
    )


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
        if eqx.is_inexact_array(leaf):
            values = np.abs(np.asarray(leaf, np.complex128)).ravel()
            signed = np.asarray(leaf, np.complex128).real.ravel()
            pattern = np.cos(np.arange(values.size))
            marks[jax.tree_util.keystr(path)] = [
                float(signed @ pattern),
                float(np.linalg.norm(values)),
            ]
    return marks


def check_same_run(
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
        if old is None or new is None or not _close(old, new):
            differ(f"the first value (projection, norm) of model{place}", old, new)


def _close(old: list[float], new: list[float]) -> bool:
    scale = max(old[1], new[1])
    return bool(np.all(np.abs(np.subtract(old, new)) <= 1e-3 * scale))
