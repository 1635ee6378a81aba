"""The trajectory of a closed loop."""

import dataclasses
from typing import Any, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._extras import extra
from .._jax import host_unless_traced, xp
from .._module import shown
from .._results import choose, first_failure, INCIDENTS, Result, RESULTS
from .._typing import Array
from ..dynamics import Events


if TYPE_CHECKING:
    import pandas


class Trajectory(eqx.Module):
    """The record of a simulation: `T` steps and `T + 1` states.

    [`delucax.rollout`][] and [`delucax.simulate`][] return it. An array that you left
    out of the argument `keep` of `rollout` is `None`. Under `jax.vmap` every array has
    a leading batch axis.

    **Attributes:**

    - `times`: the times of the states, shape `(T + 1,)`, in units of time.
    - `states`: shape `(T + 1, n)`.
    - `observations`: the observations that the controller got, shape `(T, p)`.
    - `controls`: the controls that were applied, after clipping to the bounds, shape
        `(T, m)`.
    - `disturbances`: shape `(T, k)`.
    - `costs`: stage costs, shape `(T,)`; 0 after termination.
    - `terminated`: whether the episode had terminated after step k, shape `(T,)`.
    - `final_state`: shape `(n,)`.
    - `final_cost`: a scalar, charged once.
    - `total_cost`: the sum of the stage costs and the final cost, a scalar.
    - `length`: the number of steps until termination, or T without termination.
    - `ended`: whether the episode terminated within the T steps.
    - `result`: the first failure, or success if nothing failed; one of
        `delucax.RESULTS`.
    - `incidents`: a dictionary from the name of each kind of incident to an array of
        booleans, shape `(T,)`. Entry k is true if the incident happened at step k. The
        kinds are

        - `"clipped_control"`: the bounds of the environment changed the control.
        - `"failed_plan"`: a plan of [`delucax.controllers.MPC`][] did not succeed.
        - `"failed_estimate"`: an estimator did not succeed.
        - `"failed_filter"`: a [`delucax.controllers.SafetyFilter`][] found no control
            that satisfies its barrier conditions.
        - `"refused_update"`: the update of a learning controller was not finite and was
            left out.
        - other incidents that a controller counts with [`delucax.controllers.Tally`][].

    - `controller_state`: the arrays of the controller's state at the end.
    - `dt`: the control interval, in units of time.
    - `steps`, `disturbance_size`: T and k, ints.
    - `keep`: the names of the arrays that were kept.
    - `recorded_times`, `recorded_observations`, `recorded_disturbances`,
        `recorded_terminated`, `recorded_events`: the arrays that are stored for
        `times`, `observations`, `disturbances`, `terminated` and `events`. One of them
        is `None` if it can be computed from other fields. In your code, use `times`,
        `observations` and so on instead of these arrays.
    - `state_names`, `control_names`, `state_units`, `control_units`, `event_names`:
        tuples of strings. `time_unit`: a string.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        zero = dlx.controllers.Zero(1)
        options = dict(key=jax.random.key(0), horizon=100, x0=[0.1, 0.0])
        trajectory = dlx.rollout(env, zero, **options)
        trajectory.states.shape, trajectory[:10].total_cost
        ```

        ```text
        ((101, 2), Array(0.655, dtype=float32))
        ```
    """

    states: Array | None
    controls: Array | None
    costs: Array | None
    final_state: Array
    final_cost: Array = eqx.field(repr=False)
    total_cost: Array
    length: Array
    ended: Array
    result: Result
    dt: Array
    # Arrays that follow from others are computed when they are read. To write them out
    # would take a batch longer than the simulation.
    recorded_times: Array | None = eqx.field(repr=False)
    recorded_observations: Array | None = eqx.field(repr=False)
    recorded_disturbances: Array | None = eqx.field(repr=False)
    recorded_terminated: Array | None = eqx.field(repr=False)
    steps: int = eqx.field(static=True, repr=False)
    keep: tuple[str, ...] = eqx.field(static=True, repr=False)
    disturbance_size: int = eqx.field(static=True, repr=False)
    state_names: tuple[str, ...] = eqx.field(static=True, repr=False)
    control_names: tuple[str, ...] = eqx.field(static=True, repr=False)
    state_units: tuple[str, ...] = eqx.field(static=True, repr=False)
    control_units: tuple[str, ...] = eqx.field(static=True, repr=False)
    time_unit: str = eqx.field(static=True, repr=False, default="s")
    incidents: dict[str, Array] | None = None
    controller_state: PyTree = eqx.field(repr=False, default=None)
    recorded_events: Events | None = eqx.field(repr=False, default=None)
    event_names: tuple[str, ...] = eqx.field(static=True, repr=False, default=())

    __repr__ = shown

    @property
    def events(self) -> Events:
        """The events of each step: [`delucax.dynamics.Events`][] with a leading axis of
        length T. `times` and `kinds` have shape `(T, max_events)`, `before` and `after`
        have shape `(T, max_events, n)`.

        **Raises:** `ValueError` if the events were not kept.
        """
        if self.recorded_events is None:
            raise ValueError(
                f"Trajectory: keep must hold 'events' to read them, got {self.keep}. "
                "Pass keep= to rollout."
            )
        return self.recorded_events

    def event_list(self) -> list[tuple[float, str]]:
        """The events of one trajectory in order, each as `(time, name)`.

        **Raises:** `ValueError` if the events were not kept, or if the trajectory is a
        batch.
        """
        if self.batch_shape:
            raise ValueError(
                "Trajectory: event_list needs one trajectory, got a batch. Index it, "
                "as in trajectory[0].event_list()."
            )
        times, kinds = np.asarray(self.events.times), np.asarray(self.events.kinds)
        at = kinds >= 0
        pairs = zip(times[at], kinds[at], strict=True)
        return [(float(time), self.event_names[kind]) for time, kind in pairs]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The shape of the batch that `jax.vmap` made; `()` for one trajectory."""
        return self.total_cost.shape

    @property
    def times(self) -> Array:
        """The times `k dt`, shape `(T + 1,)`."""
        if self.recorded_times is not None:
            return self.recorded_times
        times = jnp.arange(self.steps + 1) * self.dt[..., None]
        return times.astype(self.final_state.dtype)

    @property
    def observations(self) -> Array | None:
        """The observations that the controller got, shape `(T, p)`."""
        if self.recorded_observations is None and "observations" in self.keep:
            return None if self.states is None else self.states[..., :-1, :]
        return self.recorded_observations

    @property
    def disturbances(self) -> Array | None:
        """The disturbances that acted, shape `(T, k)`."""
        if self.recorded_disturbances is None and "disturbances" in self.keep:
            shape = (*self.batch_shape, self.steps, self.disturbance_size)
            return jnp.zeros(shape, self.final_state.dtype)
        return self.recorded_disturbances

    @property
    def terminated(self) -> Array | None:
        """Whether the episode had terminated after step k, shape `(T,)`."""
        if self.recorded_terminated is None and "terminated" in self.keep:
            return jnp.zeros((*self.batch_shape, self.steps), bool)
        return self.recorded_terminated

    @property
    def failed(self) -> Array:
        """Whether `result` is a failure other than `plan_failed`, `estimate_failed` and
        `filter_failed`, which the controller handles."""
        handled = (
            RESULTS.successful,
            RESULTS.plan_failed,
            RESULTS.estimate_failed,
            RESULTS.filter_failed,
        )
        return _is_none_of(self.result._value, [np.asarray(r._value) for r in handled])

    @property
    def incident_counts(self) -> dict[str, Array]:
        """The number of steps at which each kind of incident happened."""
        return {name: jnp.sum(now, -1) for name, now in self._incidents().items()}

    @property
    def incident_times(self) -> dict[str, Array]:
        """The time of the first incident of each kind; NaN if there was none."""

        def first(now):
            k = jnp.argmax(now, -1, keepdims=True)
            time = jnp.take_along_axis(self.times, k, axis=-1)[..., 0]
            return jnp.where(jnp.any(now, -1), time, jnp.nan)

        return {name: first(now) for name, now in self._incidents().items()}

    def _incidents(self) -> dict[str, Array]:
        if self.incidents is None:
            raise ValueError(
                f"Trajectory: keep must hold 'incidents' to count them, got "
                f"{self.keep}. Pass keep= to rollout."
            )
        return self.incidents

    def __getitem__(self, index: Any) -> "Trajectory":
        """Members of a batch, or a part of one trajectory.

        For a batch, `trajectory[i]` and `trajectory[2:5]` pick members. For one
        trajectory, `trajectory[start:stop]` holds the steps from `start` up to `stop`,
        with the states at both ends. The `total_cost` of this part is the cost of its
        steps, and includes the final cost if the last step is among them.

        **Arguments:** `index`: an integer or a slice.

        **Raises:** `ValueError` if the index of one trajectory is not a slice with a
        step of 1; `IndexError` beyond the batch.
        """
        if self.batch_shape:
            size = self.batch_shape[0]
            if isinstance(index, int | np.integer) and not -size <= index < size:
                raise IndexError(
                    f"Trajectory: index must be from {-size} to {size - 1} in a batch "
                    f"of {size}, got {index}."
                )
            return jax.tree.map(lambda leaf: leaf[index], self)
        if not isinstance(index, slice) or index.step not in (None, 1):
            raise ValueError(
                "Trajectory: index must be a slice such as trajectory[10:20] for one "
                f"trajectory, got {index!r}."
            )
        # An index beyond the end is clipped, like that of a list.
        start, stop, _ = index.indices(self.steps)
        stop = max(stop, start)
        if self.states is None or (self.costs is None and "costs" not in self.keep):
            raise ValueError(
                "Trajectory: keep must hold 'states' and 'costs' to slice in time, got "
                f"{self.keep}."
            )
        ends = lambda tree: jax.tree.map(lambda leaf: leaf[start : stop + 1], tree)
        steps = lambda tree: jax.tree.map(lambda leaf: leaf[start:stop], tree)
        costs, incidents = steps(self.costs), steps(self.incidents)
        # A failure by incidents becomes the first of those in the slice, if any.
        result, is_end = self.result, stop == self.steps
        by_incident, first = jnp.zeros((), bool), RESULTS.successful
        for name, kind in INCIDENTS.items():
            if incidents is not None and name in incidents:
                by_incident |= result == kind
                here = choose(jnp.any(incidents[name]), kind, RESULTS.successful)
                first = first_failure(first, here)
        if first is not RESULTS.successful:
            result = choose(by_incident, first, result)
        # The run has its final cost at its own end, which may be before the last row.
        has_end = (start < self.length) & (self.length <= stop)
        final_cost = jnp.where(has_end, self.final_cost, 0)
        return dataclasses.replace(
            self,
            states=ends(self.states),
            controls=steps(self.controls),
            costs=costs,
            final_state=self.states[stop],
            final_cost=final_cost,
            total_cost=final_cost if costs is None else jnp.sum(costs) + final_cost,
            length=jnp.clip(self.length - start, 0, stop - start),
            ended=self.ended & (self.length <= stop),
            result=result,
            recorded_times=ends(self.times),
            recorded_observations=steps(self.recorded_observations),
            recorded_disturbances=steps(self.recorded_disturbances),
            recorded_terminated=steps(self.recorded_terminated),
            incidents=incidents,
            recorded_events=steps(self.recorded_events),
            controller_state=self.controller_state if is_end else None,
            steps=stop - start,
        )

    def to_pandas(self) -> "pandas.DataFrame":
        """A table with one row per time: `time`, states, controls, disturbances and
        `cost`.

        For a batch, the column `batch` holds the index of the trajectory; if the batch
        has several axes, the columns `batch0`, `batch1`, ... hold the indices. If a
        name is already in use, `state`, `control` or `disturbance` is put before it.
        The last row of each trajectory has no control, disturbance or cost.

        **Returns:** a `pandas.DataFrame`.

        **Raises:** `ImportError` if pandas is not installed
        (`pip install "delucax[tables]"`).
        """
        pd = extra("pandas", "tables")

        columns: dict[str, np.ndarray] = {}
        axes = self.batch_shape
        shape = (*axes, self.steps + 1)
        for i in range(len(axes)):
            name = "batch" if len(axes) == 1 else f"batch{i}"
            index = np.arange(axes[i]).reshape((-1,) + (1,) * (len(shape) - i - 1))
            columns[name] = np.broadcast_to(index, shape)
        columns["time"] = np.broadcast_to(self.times, shape)

        def put(kind, names, array):
            if array is None:
                return
            array = np.asarray(array)
            width = [(0, 0)] * array.ndim
            width[-2] = (0, shape[-1] - array.shape[-2])
            array = np.pad(array, width, constant_values=np.nan)
            for i, name in enumerate(names):
                # A user's names may be the same, or be one of these columns.
                name = f"{kind} {name}" if name in columns else name
                name = f"{name} {i}" if name in columns else name
                columns[name] = array[..., i]

        cost = None if self.costs is None else self.costs[..., None]
        put("", ["cost"], cost)
        put("state", self.state_names, self.states)
        put("control", self.control_names, self.controls)
        names = [f"w{i}" for i in range(self.disturbance_size)]
        put("disturbance", names, self.disturbances)
        if "cost" in columns:
            columns["cost"] = columns.pop("cost")  # the last column
        return pd.DataFrame({k: np.ravel(v) for k, v in columns.items()})

    def statistics(self) -> dict[str, Array]:
        """Statistics over a batch: of the total cost, and of how the episodes ended.

        One trajectory counts as a batch of one. The method works under `jax.jit`.

        **Returns:** a dictionary to scalars. `"5%"`, `"25%"`, `"50%"`, `"75%"`, `"95%"`
        and `"mean"` are quantiles and the mean of the total cost, over the members
        whose cost is finite (NaN if there are none). `"finite"` is the fraction of the
        members whose total cost is finite, `"successful"` the fraction that did not
        fail (see `failed`), and `"terminated"` the fraction whose episode terminated.

        !!! example

            ```python
            import delucax as dlx
            import jax

            env, zero = dlx.make("pendulum"), dlx.controllers.Zero(1)
            run = lambda key: dlx.rollout(env, zero, key=key, throw=False)
            batch = jax.vmap(run)(jax.random.split(jax.random.key(0), 100))
            batch.statistics()["50%"]
            ```

            ```text
            Array(1179.5, dtype=float32)
            ```
        """
        total = self.total_cost
        finite = jnp.isfinite(total)
        total = jnp.where(finite, total, jnp.nan)
        levels = (5, 25, 50, 75, 95)
        # Members that diverged are left out, because they would make the mean infinite.
        quantiles = jnp.nanquantile(total, jnp.array(levels, total.dtype) / 100)
        return {f"{q}%": value for q, value in zip(levels, quantiles, strict=True)} | {
            "mean": jnp.nanmean(total),
            "finite": jnp.mean(finite),
            "successful": jnp.mean(~self.failed),
            "terminated": jnp.mean(self.ended),
        }

    def summary(self) -> "pandas.DataFrame":
        """A table of costs, lengths and outcomes, with one row per trajectory.

        The columns are `total_cost`, `final_cost`, `mean_cost` (per step), `length`,
        `terminated` and `result`. Each kind of incident that happened, such as
        `failed_plan`, adds two columns: `failed_plan_count`, the number of its steps,
        and `failed_plan_time`, the time of the first.

        **Returns:** a `pandas.DataFrame`.

        **Raises:** `ImportError` if pandas is not installed
        (`pip install "delucax[tables]"`).
        """
        pd = extra("pandas", "tables")

        given = self.total_cost, self.length, self.final_cost
        total, length, final = map(np.ravel, given)
        # A result that is statically a success has no batch axis.
        codes = np.broadcast_to(np.ravel(jax.tree.leaves(self.result)[0]), total.shape)
        result_of = lambda c: jax.tree.map(lambda _: np.asarray(c), RESULTS.successful)
        words = [RESULTS[result_of(code)] or "successful" for code in codes]
        columns = {
            "total_cost": total,
            "final_cost": final,
            "mean_cost": (total - final) / np.maximum(length, 1),
            "length": length,
            "terminated": np.broadcast_to(np.ravel(self.ended), total.shape),
            "result": words,
        }
        for name in self.incidents or ():
            count = np.ravel(self.incident_counts[name])
            if count.any():
                columns[f"{name}_count"] = count
                columns[f"{name}_time"] = np.ravel(self.incident_times[name])
        return pd.DataFrame(columns)


@host_unless_traced
def _is_none_of(index: Array, known: list[Any]) -> Array:
    return xp.all(xp.stack(known) != index[..., None], axis=-1)
