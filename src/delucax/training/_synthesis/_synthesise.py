"""Policy synthesis: a trained policy for an environment, without settings."""

import contextlib
import warnings
from typing import Any, NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._check import (
    check_bool,
    check_count,
    check_instance,
    check_key,
    check_number,
    is_concrete,
)
from ..._controller import AbstractController
from ..._extras import extra
from ..._typing import PRNGKey
from ...controllers import Constant, Zero
from ...environments import Environment
from .._costs import expected_cost
from ._attempt import Attempt
from ._episode_costs import costs_of, first_steps
from ._policy_search import CHOICE, PolicySearch
from ._structures import simplified


if TYPE_CHECKING:
    import pandas


_WHERE = "synthesise"
# In less time, in seconds, not even the first programs compile.
_LEAST_BUDGET = 10.0


class Synthesis(NamedTuple):
    """The result of [`delucax.training.synthesise`][].

    **Attributes:**

    - `policy`: the controller that was chosen.
    - `structure`: the structure of the policy: `"zero"`, `"LQR"`, `"LQG"`, `"network"`,
        `"memory"` (a recurrent network), `"LQR + network"`, `"LQR + memory"` or
        `"LQG + memory"`.
    - `costs`: a dictionary from the name of a controller to its total cost in each
        episode; the names are `"policy"`, `"zero"`, `"LQR"` or `"LQG"`, `"MPC"` and
        `"plan"`. All controllers run the same episodes, which were not used for
        training or for the choice of the policy. A controller is missing if it does not
        exist for the environment or if the budget left no time for it. MPC and the plan
        know the plant, and the plan also knows the whole state and all disturbances in
        advance. So a policy may not be able to reach the cost of the plan. But the plan
        is only a local minimum: iLQR improves the controls of the policy, and cannot
        improve them where the gradient of the cost is zero.
    - `tried`: a list of [`delucax.training.Attempt`][], in the order in which they were
        trained; the list begins with zero control and the LQR or LQG.
        `pandas.DataFrame(tried)` makes a table of it.
    - `seconds`: the time it took.
    - `plants`: a dictionary from each path of `ranges` to the value of this parameter
        in each episode of the comparison; empty if there are no `ranges`.
    - `ended`: why the training ended: `"the time was over"`,
        `"no training lowered the cost any more"`, `"the LQR was as good as a plan"` (or
        `"the LQR was as good as MPC"`, if there are disturbances), or `"interrupted"`.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np

        costs = {"policy": np.array([1.0, 2.0]), "zero": np.array([5.0, 9.0])}
        zero = dlx.controllers.Zero(1)
        made = dlx.training.Synthesis(zero, "zero", costs, [], 5.0)
        print(made)
        made.to_pandas()
        ```

        ```text
        Synthesis(structure='zero', seconds=5.0, ended='interrupted', 0 tried)
        mean cost over 2 episodes: policy 1.5, zero 7
                mean  median  worst
        policy   1.5     1.5    2.0
        zero     7.0     7.0    9.0
        ```
    """

    policy: AbstractController
    structure: str
    costs: dict[str, np.ndarray]
    tried: list[Attempt]
    seconds: float
    plants: dict[str, np.ndarray] = {}
    ended: str = "interrupted"

    def __repr__(self) -> str:
        about = f"structure={self.structure!r}, seconds={self.seconds:.1f}"
        about += f", ended={self.ended!r}, {len(self.tried)} tried"
        means = {name: np.mean(costs) for name, costs in self.costs.items()}
        said = ", ".join(f"{name} {mean:.4g}" for name, mean in means.items())
        count = max(map(len, self.costs.values()), default=0)
        return f"Synthesis({about})\nmean cost over {count} episodes: {said}"

    def to_pandas(self) -> "pandas.DataFrame":
        """A table with a row for each controller in the comparison.

        **Returns:** a `pandas.DataFrame` with the mean, median and worst cost. For a
        family of plants, the table also has the parameters of the median and of the
        worst episode.

        **Raises:** `ImportError` without pandas (`pip install "delucax[tables]"`).
        """
        rows = {}
        for name, costs in self.costs.items():
            order = np.argsort(costs)
            # Of an even number of episodes, the upper one of the two in the middle.
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
    r"""Train a policy for an environment within a time budget, without tuning.

    The search tries several structures and training methods, refines the best of them,
    and compares the result with known controllers:

    1. Baselines: zero control, and the LQR of [`delucax.controllers.local_lqr`][]. If
        the state is not observed, or the sensor has noise, the state is called hidden.
        If the state is hidden, the LQG of [`delucax.controllers.local_lqg`][] replaces
        the LQR as a baseline. A baseline is left out, with a warning, if it does not
        exist for the environment.
    2. Trials. Two policies are tried: a network that corrects the LQR
        ([`delucax.controllers.Residual`][]), and a network alone. If you pass `ranges`,
        the network that corrects the LQR is recurrent, so that it can identify the
        plant from past observations. If the state is hidden, both networks are
        recurrent. Each policy is trained in two ways, each time from its initial
        weights. The first way is the gradient of a rollout of at most 200 steps
        ([`delucax.training.ClippedSamples`][]). At first this gradient is damped with a
        time constant of a thirtieth of the rollout, then with a tenth and a quarter of
        the rollout. In the end the gradient is not damped. The second way is
        [`delucax.training.evolve`][], which needs no gradient. If the plant has events,
        evolution comes before the gradient. Evolution trains only the weights of a
        network. The gradient also trains the bounds of the network and the scales of
        its features. Neither of them changes the LQR. If neither the first two trials
        nor a plan is better than the LQR, the training ends.
    3. Refinement. The better half of the trained policies is trained further, and then
        the better half of these, until one policy is left. If there is still time, the
        other policies are trained after it. A policy whose cost is more than one and a
        half times the lowest cost also waits until then. For each policy, every method
        is tried once. After that, the method that lowered the cost most is used first.
        If a method lowers the cost by less than 0.1%, its learning rate (in evolution,
        its standard deviation) is reduced to a tenth. If this happens again, the method
        is not used any more for this policy.
    4. Choice. The candidates are the four best policies, the best policy of each
        structure, and the baselines. They are compared by their mean cost over up to
        448 new initial states, and over the 64 initial states that were already used to
        compare policies during the training. Each cost $c$ counts as
        $20 s \log(1 + c / 20 s)$, so that a rare episode of a huge cost does not
        outweigh all others. Here $s$ is about the lowest median cost so far. If the
        cost of a baseline is at most half a percent higher than the best, the search
        returns the baseline.
    5. Comparison. The chosen policy and the baselines run new episodes. If time is
        left, MPC runs the same episodes, and iLQR computes a plan for each of them,
        which starts from the controls of the policy. MPC needs an observed state.

    An interrupt (`KeyboardInterrupt`) ends the training. The choice and the comparison
    still follow, but a further interrupt ends the one that is running. In any case
    `synthesise` returns the best policy so far.

    **Arguments:**

    - `environment`: the environment. The dynamics and the cost must be differentiable.
        If a control has no bounds, a network keeps it in a range: the median of the
        LQR's control plus or minus two of its standard deviations. If the LQR's control
        hardly varies, the range is the median plus or minus 2. Without an LQR, the
        range is -2 to 2. If the control has only one bound, the range has the same
        width, but begins at this bound.
    - `key`: a random key.
    - `budget`: the time for everything, including compilation, in seconds; 75 by
        default, at least 10. Training may take 70% of the budget, and the rest is for
        the choice and the comparison. If MPC and the plans are likely to take longer
        than this rest, both are left out, and training may take 90% of the budget. MPC
        and the plans may exceed the budget by a tenth. If a program is being compiled
        when the time is over, its compilation is finished first. If the budget ends
        before the first training, you get a warning, and a single policy is trained.
        The number of trials depends on the speed of the machine, so the same key can
        give another policy on another machine, or when the programs are compiled
        already.
    - `ranges`: ranges of parameters, as in [`delucax.randomise`][], for a policy that
        works on a family of plants; each episode draws its own plant from the ranges.
        The LQR is designed for the nominal plant; MPC and the plan know each plant.
        None by default: one plant.
    - `width`, `depth`: the units in a hidden layer, and the number of hidden layers of
        the networks; 32 and 1 by default. A recurrent network has one layer.
    - `progress`: whether to show a progress bar with the time and the lowest cost so
        far; true by default.

    **Returns:** a [`delucax.training.Synthesis`][].

    **Raises:** `ValueError`, before any training, if an argument has the wrong type, if
    the dynamics or the cost are not differentiable, if an initial state or its cost is
    not finite, or if the first step is not finite with any of about 16 controls that
    are tried. Warns if the cost of the policy is not finite in some episodes of the
    choice or the comparison.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("double_integrator", horizon=20)
        made = dlx.training.synthesise(env, key=jax.random.key(0), budget=10.0)
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
    if ranges is not None and not ranges:
        raise ValueError(
            f"{_WHERE}: ranges must name at least one parameter, or be None for a "
            f"single plant, got {ranges!r}."
        )
    width = check_count(width, "width", _WHERE)
    depth = check_count(depth, "depth", _WHERE)
    check_bool(progress, "progress", _WHERE)
    search = PolicySearch(environment, ranges, key, float(budget), progress)
    with search.bar:
        costs = _check_environment(environment, ranges, search.choice_keys[:CHOICE])
        # If an interrupt comes before the first trial, this is the result.
        search.enter(search.best["zero"]._replace(costs=costs))
        # An interrupt ends each of the three parts, and the next one goes on with what
        # is known.
        with contextlib.suppress(KeyboardInterrupt):
            search.run(width, depth)
        with contextlib.suppress(KeyboardInterrupt):
            search.choose()
        structure, policy = search.chosen()
        compared: dict[str, np.ndarray] = {}
        with contextlib.suppress(KeyboardInterrupt):
            for name, values in search.compare(policy):
                compared[name] = values
    own = np.concatenate([search.best[structure].costs, compared.get("policy", [])])
    if lost := np.sum(~np.isfinite(own)):
        warnings.warn(
            f"{_WHERE}: the cost of {structure!r}, which is returned, is not finite "
            f"from {lost} of the {len(own)} initial states of the choice and the "
            "comparison.",
            stacklevel=2,
        )
    about = search.budget.spent, search.plants(), search.ended
    simple = simplified(structure, policy)
    return Synthesis(simple, structure, compared, search.tried, *about)


def _check_environment(
    env: Environment, ranges: dict[str, Any] | None, keys: Any
) -> np.ndarray:
    """The costs of zero control. Raise if no method could train a policy for the
    environment."""
    loss = expected_cost(env, batch=1, horizon=1, ranges=ranges)
    held = Constant(jnp.zeros(env.control_size))
    try:
        jax.eval_shape(eqx.filter_grad(loss), held, keys[0])
    except Exception as error:
        reason, *_ = str(error).splitlines() or [f"{type(error).__name__}."]
        raise ValueError(
            f"{_WHERE}: environment must have dynamics and a cost that JAX can "
            f"differentiate, got: {reason} If that is not possible, use "
            "delucax.training.evolve."
        ) from error
    # The search needs this program anyway. That of the first steps, which tells what is
    # wrong, is compiled only if something is.
    uncontrolled = np.asarray(
        costs_of(env, ranges, Zero(env.control_size), keys), float
    )
    if np.isfinite(uncontrolled).all():
        return uncontrolled
    starts, costs, steps = map(np.asarray, first_steps(env, ranges, keys))
    checked = (
        ("initial state", np.isfinite(starts).all(axis=1)),
        # Of several controls, because a cost may be infinite at zero control.
        ("cost of an initial state", np.isfinite(costs).any(axis=1)),
    )
    for what, finite in checked:
        if not finite.all():
            x = starts[finite.argmin()]
            raise ValueError(
                f"{_WHERE}: the {what} must be finite, but it is not at x0 = {x}."
            )
    kept = np.isfinite(steps).all(axis=-1).any(axis=1)
    if not kept.all():
        raise ValueError(
            f"{_WHERE}: none of {steps.shape[1]} controls keeps the first step finite "
            f"from x0 = {starts[kept.argmin()]}."
        )
    return uncontrolled
