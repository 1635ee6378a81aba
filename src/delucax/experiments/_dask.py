"""A cluster by its address."""

from typing import Any

from .._extras import extra


def client(address: str) -> Any:
    """A client of the scheduler at `address`, a context manager.

    **Raises:** `OSError` if there is none; `ImportError` without the extra `dask`.
    """
    distributed = extra("distributed", "dask")
    return distributed.Client(address, timeout=20)
