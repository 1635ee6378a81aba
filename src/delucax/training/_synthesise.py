"""A policy for any environment with a model, from one call."""

import warnings
from typing import Any, NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._check import (
    check_bool,
    check_count,
    check_instance,
    check_key,
    check_number,
    is_concrete,
)
from .._controller import AbstractController
from .._extras import extra
from .._typing import PRNGKey
from ..controllers import Constant
from ..environments import Environment
from ._attempt import Attempt
from ._costs import expected_cost
from ._episode_costs import first_steps
from ._policy_search import CHOICE, PolicySearch


if TYPE_CHECKING:
    import pandas


_WHERE = "synthesise"
# Seconds below which not even the first programs compile.
_LEAST_BUDGET = 5.0


class Synthesis(NamedTuple):
    """The result of `synthesise`.

    **Attributes:**

    - `policy`: the controller that was chosen.
    - `structure`: what it is: `"zero"`, `"LQR"`, `"network"`, `"memory"`,
        `"LQR + network"` or `"LQR + memory"`.
    - `costs`: from `"policy"`, `"zero"`, `"LQR"`, `"MPC"` and `"plan"` to the costs of
        episodes from starts that were used for nothing else, the same for each; those
        that do not apply, or that the budget leaves no time for, are left out.
    - `tried`: a list of `Attempt`s, in the order in which they were made.
    - `seconds`: what it took.
    - `plants`: of a family, from each path of `ranges` to what the plants of these
        episodes have there; empty otherwise.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np

        costs = {"policy": np.array([1.0, 2.0]), "zero": np.array([5.0, 9.0])}
        zero = dlx.controllers.Zero(1)
        dlx.training.Synthesis(zero, "zero", costs, [], 5.0).to_pandas()
        ```
    """

    policy: AbstractController
    structure: str
    costs: dict[str, np.ndarray]
    tried: list[Attempt]
    seconds: float
    plants: dict[str, np.ndarray] = {}

    def to_pandas(self) -> "pandas.DataFrame":
        """A table with a row for each controller that was compared: mean, median and
        worst cost, and of a family the plant of the median and of the worst episode.

        **Returns:** a `pandas.DataFrame`.

        **Raises:** `ImportError` without pandas (`pip install "delucax[tables]"`).
        """
        rows = {}
        for name, costs in self.costs.items():
            order = np.argsort(costs)
            places = {"median": order[len(order) // 2], "worst": order[-1]}
            rows[name] = dict(
                mean=np.mean(costs), median=np.median(costs), worst=np.max(costs)
            ) | {
                f"{path}, {what}": values[at]
                for what, at in places.items()
                for path, values in self.plants.items()
            }
        return extra("pandas", "tables").DataFrame.from_dict(rows, orient="index")


def synthesise(
    environment: Environment,
    *,
    key: PRNGKey,
    budget: Any = 75.0,
    ranges: dict[str, Any] | None = None,
    width: int = 32,
    depth: int = 1,
    progress: bool = True,
) -> Synthesis:
    """A policy for an environment with a model, without settings of the task.

    It tries, compares and refines:

    1. The floor: no control, and the LQR of [`delucax.controllers.local_lqr`][] where
        there is one.
    2. Trials: a network that corrects the LQR ([`delucax.controllers.Residual`][]) and
        a network alone. With `ranges` the one that corrects is recurrent, because it
        can then tell the plant from what it has observed; where the state is not
        observed, a recurrent network alone is tried. Each is trained by the gradient of
        the rollout of at most 200 steps ([`delucax.training.ClippedSamples`][]), by
        that gradient damped over a quarter, a tenth and a thirtieth of these, and by
        [`delucax.training.evolve`][], which needs no gradient. If after the first two
        trials neither they nor a plan are better than the LQR, it ends with the LQR.
    3. Refinement: the better third goes on for three times as long, until one is left.
        That one is trained by the methods that still gain, then at a tenth of the
        learning rate. Once none gains, an imitation of MPC
        ([`delucax.training.imitate`][]) is tried, if MPC costs less.
    4. Choice among the last four and the floor, on up to 512 starts that none was
        trained on, by the mean cost, in which costs above 20 times the usual one count
        by their logarithm. Where the
        LQR, or no control, is as good to half a percent, that is returned.

    **Arguments:**

    - `environment`: the environment. Its dynamics and cost must be differentiable.
        Where a control has no bounds, a network keeps it within two standard deviations
        of the LQR's control around zero, or within 2 without an LQR; where it has one
        bound, in a range of that size from it.
    - `key`: a random key.
    - `budget`: seconds for all of it with compilation, 75 by default, at least 5. A
        training or comparison that has begun is finished. What is tried depends on the
        speed of the machine, and so does the result.
    - `ranges`: of parameters, as in [`delucax.randomise`][]: the policy is for a family
        of plants, one of which each episode draws. The LQR is that of the nominal
        plant; MPC and the plan know each plant. None by default.
    - `width`, `depth`: of the networks, 32 and 1 by default.
    - `progress`: whether to show a bar with the seconds and the cost so far; true by
        default.

    An interrupt (`KeyboardInterrupt`) ends the training, and returns the best so far.

    **Returns:** a [`delucax.training.Synthesis`][].

    **Raises:** `ValueError` on an argument of the wrong kind; if the cost of a first
    state is not finite, no control keeps one finite over the first step, or the
    dynamics or the cost have no derivative; all before anything is trained. A warning
    if the cost of the policy is not finite from every start.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("double_integrator", horizon=20)
        made = dlx.training.synthesise(env, key=jax.random.key(0), budget=5.0)
        made.structure, made.costs["policy"].mean()
        ```
    """
    check_instance(environment, Environment, "environment", _WHERE)
    key = check_key(key, _WHERE)
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves((environment, key))):
        raise ValueError(
            f"{_WHERE}: environment and key must hold values; {_WHERE} cannot be "
            "called under jax.jit, jax.vmap or jax.grad."
        )
    check_number(budget, "budget", _WHERE)
    if budget < _LEAST_BUDGET:
        raise ValueError(
            f"{_WHERE}: budget must be at least {_LEAST_BUDGET:g} s, which the first "
            f"programs take to compile, got {budget}."
        )
    width = check_count(width, "width", _WHERE)
    depth = check_count(depth, "depth", _WHERE)
    check_bool(progress, "progress", _WHERE)
    search = PolicySearch(environment, ranges, key, float(budget), progress)
    with search.bar:
        _check_environment(environment, ranges, search.keys(CHOICE))
        try:
            search.run(width, depth)
        except KeyboardInterrupt:
            pass
        structure, policy = search.choose()
        costs = search.compared(policy)
    if lost := np.sum(~np.isfinite(costs["policy"])):
        warnings.warn(
            f"{_WHERE}: the cost of {structure!r}, which is returned, is not finite "
            f"from {lost} of {len(costs['policy'])} starts.",
            stacklevel=2,
        )
    tried, plants = search.tried, search.plants()
    return Synthesis(policy, structure, costs, tried, search.seconds, plants)


def _check_environment(
    env: Environment, ranges: dict[str, Any] | None, keys: Any
) -> None:
    """Raise where nothing could be trained, whatever the method."""
    loss = expected_cost(env, batch=1, horizon=1, ranges=ranges)
    held = Constant(jnp.zeros(env.control_size))
    try:
        jax.eval_shape(eqx.filter_grad(loss), held, keys[0])
    except Exception as error:
        reason, *_ = str(error).splitlines() or [f"{type(error).__name__}."]
        raise ValueError(
            f"{_WHERE}: environment must have dynamics and a cost that JAX can "
            f"differentiate, got: {reason} For others use delucax.training.evolve."
        ) from error
    starts, costs, steps = map(np.asarray, first_steps(env, keys))
    for what, values in (("first state", starts), ("cost of a first state", costs)):
        finite = np.isfinite(values.reshape(len(keys), -1)).all(axis=1)
        if not finite.all():
            x = starts[finite.argmin()]
            raise ValueError(f"{_WHERE}: the {what} must be finite, at x0 = {x}.")
    kept = np.isfinite(steps).all(axis=-1).any(axis=1)
    if not kept.all():
        raise ValueError(
            f"{_WHERE}: no control keeps the first step finite from x0 = "
            f"{starts[kept.argmin()]}."
        )
