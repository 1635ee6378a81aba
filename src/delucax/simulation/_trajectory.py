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
from .._results import choose, INCIDENTS, Result, RESULTS
from .._typing import Array
from ..dynamics import Events


if TYPE_CHECKING:
    import pandas


class Trajectory(eqx.Module):
    """The record of a closed loop: `T` steps from `T + 1` states.

    Arrays that `keep=` leaves out are `None`. Under `jax.vmap` every array has a
    leading batch axis.

    **Attributes:**

    - `times`: shape `(T + 1,)`.
    - `states`: shape `(T + 1, n)`.
    - `observations`: those given to the controller, shape `(T, p)`.
    - `controls`: what was applied, after the bounds, shape `(T, m)`.
    - `disturbances`: shape `(T, k)`.
    - `costs`: stage costs, shape `(T,)`; 0 after termination.
    - `terminated`: whether the episode had terminated after step k, shape `(T,)`.
    - `final_state`: shape `(n,)`.
    - `final_cost`: a scalar, charged once.
    - `total_cost`: the sum of the stage costs and the final cost.
    - `length`: steps until termination, T if there was none.
    - `ended`: whether the episode terminated within the T steps.
    - `result`: the first failure, or success; one of `delucax.RESULTS`.
    - `incidents`: from the name of something that went wrong in the controller to the
        steps at which it did, booleans of shape `(T,)`. `"clipped_control"`: the
        environment's bounds changed the control. `"failed_plan"`: a plan of
        [`delucax.controllers.MPC`][] did not succeed. `"failed_estimate"`: nor did an
        estimator. `"failed_filter"`: a [`delucax.controllers.SafetyFilter`][] found no
        control that keeps its barriers. `"refused_update"`: what a learner would have
        learned was not finite. Others are those that a controller counts with
        [`delucax.controllers.Tally`][].
    - `controller_state`: the arrays of the controller's state at the end.
    - `steps`: T, an int. `dt`: the control interval. `disturbance_size`: k.
    - `keep`: the names of what was kept.
    - `recorded_times`, `recorded_observations`, `recorded_disturbances`,
        `recorded_terminated`, `recorded_events`: the arrays behind `times`,
        `observations`, `disturbances`, `terminated` and `events` where they do not
        follow from the rest.
    - `state_names`, `control_names`, `state_units`, `control_units`, `event_names`:
        tuples of strings.
    - `time_unit`: a string.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        zero = dlx.controllers.Zero(1)
        trajectory = dlx.rollout(
            env, zero, key=jax.random.key(0), horizon=100, x0=[0.1, 0.0]
        )
        trajectory.total_cost, trajectory.states.shape, trajectory[:10].costs
        ```
    """

    states: Array | None
    controls: Array | None
    costs: Array | None
    final_state: Array
    final_cost: Array
    total_cost: Array
    length: Array
    ended: Array
    result: Result
    dt: Array
    # Arrays that follow from others are computed lazily: to write them out would cost a
    # batch more than the simulation does.
    recorded_times: Array | None
    recorded_observations: Array | None
    recorded_disturbances: Array | None
    recorded_terminated: Array | None
    steps: int = eqx.field(static=True)
    keep: tuple[str, ...] = eqx.field(static=True)
    disturbance_size: int = eqx.field(static=True)
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)
    state_units: tuple[str, ...] = eqx.field(static=True)
    control_units: tuple[str, ...] = eqx.field(static=True)
    time_unit: str = eqx.field(static=True, default="s")
    incidents: dict[str, Array] | None = None
    controller_state: PyTree = None
    recorded_events: Events | None = None
    event_names: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def events(self) -> Events:
        """The events of each step, [`delucax.dynamics.Events`][] with a leading axis of
        T: `times` and `kinds` have the shape `(T, max_events)`, and the states `before`
        and `after` them `(T, max_events, n)`.

        **Raises:** `ValueError` if they were not kept.
        """
        if self.recorded_events is None:
            raise ValueError(
                "Trajectory: events must be kept to be read: give keep= with 'events', "
                f"got {self.keep}."
            )
        return self.recorded_events

    def event_list(self) -> list[tuple[float, str]]:
        """The events of one trajectory, each as its time and name, in their order.

        **Raises:** `ValueError` if they were not kept, or of a batch.
        """
        if self.batch_shape:
            raise ValueError(
                "Trajectory: event_list is of one trajectory, got a batch: index it, "
                "as in trajectory[0]."
            )
        times, kinds = np.asarray(self.events.times), np.asarray(self.events.kinds)
        at = kinds >= 0
        pairs = zip(times[at], kinds[at], strict=True)
        return [(float(time), self.event_names[kind]) for time, kind in pairs]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading axes that `jax.vmap` put there; `()` for one trajectory."""
        return self.total_cost.shape

    @property
    def times(self) -> Array:
        """`t_k = k dt`, shape `(T + 1,)`."""
        if self.recorded_times is not None:
            return self.recorded_times
        times = jnp.arange(self.steps + 1) * self.dt[..., None]
        return times.astype(self.final_state.dtype)

    @property
    def observations(self) -> Array | None:
        """The observations given to the controller, shape `(T, p)`."""
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
        """Whether a step failed, the run diverged, or a learner refused an update:
        `result` is not `successful`, `plan_failed`, `estimate_failed` or
        `filter_failed`."""
        handled = (
            RESULTS.successful,
            RESULTS.plan_failed,
            RESULTS.estimate_failed,
            RESULTS.filter_failed,
        )
        return _is_none_of(self.result._value, [np.asarray(r._value) for r in handled])

    @property
    def incident_counts(self) -> dict[str, Array]:
        """At how many steps each of `incidents` happened."""
        return {name: jnp.sum(now, -1) for name, now in self._incidents().items()}

    @property
    def incident_times(self) -> dict[str, Array]:
        """When each of `incidents` happened first; NaN where it never did."""

        def first(now):
            k = jnp.argmax(now, -1, keepdims=True)
            time = jnp.take_along_axis(self.times, k, axis=-1)[..., 0]
            return jnp.where(jnp.any(now, -1), time, jnp.nan)

        return {name: first(now) for name, now in self._incidents().items()}

    def _incidents(self) -> dict[str, Array]:
        if self.incidents is None:
            raise ValueError(
                "Trajectory: incidents must be kept to be counted: give keep= with "
                "'incidents', got it without."
            )
        return self.incidents

    def __getitem__(self, index: Any) -> "Trajectory":
        """Members of a batch, or a stretch of time of one trajectory.

        Of a batch, `trajectory[i]` and `trajectory[2:5]` pick members. Of one
        trajectory, `trajectory[start:stop]` are the steps from `start` up to `stop`,
        with the states at both ends; `total_cost` is then theirs, and includes the
        final cost only if the last step is among them.

        **Raises:** `ValueError` if one trajectory is indexed by anything but a slice
        of step 1; `IndexError` beyond the batch.
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
                "Trajectory: one trajectory takes a slice such as trajectory[10:20]; "
                f"got {index!r}."
            )
        # As of a list, an index beyond the end is clipped.
        start, stop, _ = index.indices(self.steps)
        stop = max(stop, start)
        if self.states is None or (self.costs is None and "costs" not in self.keep):
            raise ValueError(
                "Trajectory: states and costs must be kept to slice in time; got "
                "keep= without them."
            )
        ends = lambda tree: jax.tree.map(lambda leaf: leaf[start : stop + 1], tree)
        steps = lambda tree: jax.tree.map(lambda leaf: leaf[start:stop], tree)
        costs, incidents = steps(self.costs), steps(self.incidents)
        # A failure by incidents is dropped if none of them is in the slice.
        result, is_end = self.result, stop == self.steps
        for name, kind in INCIDENTS.items():
            if incidents is not None and name in incidents:
                elsewhere = (result == kind) & ~jnp.any(incidents[name])
                result = choose(elsewhere, RESULTS.successful, result)
        final_cost = self.final_cost if is_end else jnp.zeros_like(self.final_cost)
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
        """A tidy table, one row a time: `time`, states, controls, `cost`.

        A state or control whose name is taken gets `state` or `control` before it. A
        batch has its index in the columns `batch` (`batch0`, `batch1`, ... if it has
        several axes). The last row of each trajectory has no control or cost.

        **Returns:** a `pandas.DataFrame`.

        **Raises:** `ImportError` without pandas (`pip install "delucax[tables]"`).
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
                # Names are the user's: two may be the same, or one of ours.
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
        """How the total cost is spread over a batch, and how its members ended.

        `"5%"`, `"25%"`, `"50%"`, `"75%"` and `"95%"` are quantiles of the total cost
        over the members whose cost is finite (NaN if there are none), `"mean"` is their
        mean; `"finite"` is the fraction of these members, `"successful"` that of the
        members that are not `failed`, and `"terminated"` that of the members whose
        episode ended early. One trajectory is a batch of one. Works under `jax.jit`.

        **Returns:** a dictionary from these names to scalars.

        !!! example

            ```python
            import delucax as dlx
            import jax

            env, zero = dlx.make("pendulum"), dlx.controllers.Zero(1)
            run = lambda key: dlx.rollout(env, zero, key=key, throw=False)
            batch = jax.vmap(run)(jax.random.split(jax.random.key(0), 100))
            batch.statistics()["50%"]
            ```
        """
        total = self.total_cost
        finite = jnp.isfinite(total)
        total = jnp.where(finite, total, jnp.nan)
        levels = (5, 25, 50, 75, 95)
        # Members that diverged are counted apart: a mean with infinity tells nothing.
        quantiles = jnp.nanquantile(total, jnp.array(levels, total.dtype) / 100)
        return {f"{q}%": value for q, value in zip(levels, quantiles, strict=True)} | {
            "mean": jnp.nanmean(total),
            "finite": jnp.mean(finite),
            "successful": jnp.mean(~self.failed),
            "terminated": jnp.mean(self.ended),
        }

    def summary(self) -> "pandas.DataFrame":
        """One row for a trajectory, one a member for a batch: cost, length, outcome.

        Columns: `total_cost`, `final_cost`, `mean_cost` (per step), `length`,
        `terminated`, `result`; and for each kind of incident that happened, such as
        `failed_plan`, the number of steps `failed_plan_count` and the time of the
        first, `failed_plan_time`.

        **Returns:** a `pandas.DataFrame`.

        **Raises:** `ImportError` without pandas (`pip install "delucax[tables]"`).
        """
        pd = extra("pandas", "tables")

        given = self.total_cost, self.length, self.final_cost
        total, length, final = map(np.ravel, given)
        # A result that is statically a success has no batch axis, but broadcasts.
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
