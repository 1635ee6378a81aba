"""A policy from one call."""

import dataclasses
import functools
import re
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once

import delucax as dlx
from delucax.controllers import local_lqg
from delucax.training import synthesise
from delucax.training._synthesis._attempt import Attempt, Candidate
from delucax.training._synthesis._budget import Budget
from delucax.training._synthesis._episode_costs import costs_of, tamed
from delucax.training._synthesis._policy_search import PolicySearch
from delucax.training._synthesis._rounds import by_evolution, by_gradient
from delucax.training._synthesis._structures import (
    _range as controls_of_a_law,
    simplified,
    structures,
)
from delucax.training._synthesis._synthesise import _check_environment


KEY = jax.random.key(0)
pytestmark = once


@functools.cache
def env():
    return dlx.make("double_integrator", horizon=80, max_force=100.0)


@functools.cache
def result():
    with warnings.catch_warnings():
        # On a slow machine the first programs take most of the budget.
        warnings.filterwarnings("ignore", "synthesise: a budget of 10 s is too small")
        return synthesise(env(), key=KEY, budget=10.0, width=8, progress=False)


def test_a_linear_plant_gets_its_regulator():
    assert result().structure == "LQR"
    assert isinstance(result().policy, dlx.controllers.LQR)


def test_what_was_tried_is_reported():
    floor, trained = result().tried[:2], result().tried[2:]
    assert [(a.structure, a.method) for a in floor] == [
        ("zero", "none"),
        ("LQR", "none"),
    ]
    structures = {attempt.structure for attempt in trained}
    assert structures and structures <= {"network", "LQR + network"}
    assert all(attempt.method != "none" for attempt in trained)
    assert all(np.isfinite(attempt.cost) for attempt in result().tried)
    assert sum(attempt.seconds for attempt in result().tried) < result().seconds


def test_the_report_is_short():
    said = repr(result())
    assert said.count("\n") == 1 and "structure='LQR'" in said
    assert f"{len(result().tried)} tried" in said and "over 16 episodes: policy" in said
    ended = "the LQR was as good as a plan", "the time was over"
    assert result().ended in ended


def test_costs_are_from_the_same_starts():
    costs = result().costs
    assert {"policy", "zero", "LQR"} <= set(costs)
    np.testing.assert_array_equal(costs["policy"], costs["LQR"])
    if "plan" in costs:
        assert np.all(costs["plan"] <= costs["policy"] * (1 + 1e-5))
    table = result().to_pandas()
    assert table.loc["zero", "mean"] == pytest.approx(costs["zero"].mean())


def test_a_family_tells_its_worst_plant():
    ranges, path = {"dynamics.system.mass": (0.5, 2.0)}, "dynamics.system.mass"
    search = PolicySearch(env(), ranges, KEY, 0.0, progress=False)
    drawn = search.plants()[path]
    zero = dlx.controllers.Zero(1)
    costs = dict(search.compare(zero))
    assert drawn.shape == costs["policy"].shape and np.ptp(drawn) > 1
    made = dlx.training.Synthesis(zero, "zero", costs, [], 1.0, {path: drawn})
    worst = made.to_pandas().loc["policy"]
    assert worst[f"{path}, worst"] == drawn[costs["policy"].argmax()]
    # The plant is that of the episode.
    key, plant_key = jax.random.split(search.comparison_keys[3])
    plant = dlx.randomise(env(), plant_key, ranges)
    assert plant.dynamics.system.mass == pytest.approx(drawn[3])
    alone = dlx.rollout(plant, zero, key=key, keep=()).total_cost
    assert alone == pytest.approx(costs["policy"][3], rel=1e-5)


def shortest(monkeypatch, task, **options):
    """The result of the shortest search: one policy is trained, in one block."""
    monkeypatch.setattr(sys.modules[synthesise.__module__], "_LEAST_BUDGET", 0.0)
    options |= dict(key=KEY, budget=0.01, width=2, progress=False)
    with pytest.warns(UserWarning, match="a budget of 0.01 s is too small"):
        return synthesise(task, **options)


def test_a_family_gets_a_policy_that_works_on_its_plants(monkeypatch):
    path = "dynamics.system.mass"
    made = shortest(monkeypatch, env(), ranges={path: (0.5, 2.0)})
    tried = [attempt.structure for attempt in made.tried]
    assert tried == ["zero", "LQR", "LQR + memory"] and "time" in made.ended
    assert set(made.costs) == {"policy", "zero", "LQR"}
    drawn = made.plants[path]
    assert drawn.shape == made.costs["policy"].shape
    assert 0.5 <= drawn.min() < 1 < drawn.max() <= 2
    assert np.all(made.costs["policy"] < made.costs["zero"])


def test_a_hidden_state_gets_a_policy_that_works_without_it(monkeypatch):
    task = hidden()
    made = shortest(monkeypatch, task)
    tried = [attempt.structure for attempt in made.tried]
    assert tried == ["zero", "LQG", "LQG + memory"]
    # MPC needs the state.
    assert set(made.costs) == {"policy", "zero", "LQG"}
    run = dlx.rollout(task, made.policy, key=KEY)
    assert run.observations.shape == (task.horizon, 1)
    zero = dlx.rollout(task, dlx.controllers.Zero(1), key=KEY)
    assert run.total_cost < 0.2 * zero.total_cost


def test_a_network_where_the_regulator_is_worse():
    # Nothing is trained: what is better by more than half a percent is chosen.
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    zero, lqr, net = (dlx.controllers.Constant([float(i)]) for i in range(3))
    enter = lambda name, policy, cost: search.enter(known(name, policy, cost))
    search.best = {}
    enter("zero", zero, 9.0)
    enter("LQR", lqr, 1.01)
    enter("network", net, 1.0)
    assert search.chosen() == ("network", net)
    enter("LQR", lqr, 1.004)
    assert search.chosen() == ("LQR", lqr)
    enter("zero", zero, 1.0)
    assert search.chosen() == ("zero", zero)


def known(name, policy, *costs):
    return Candidate(name, "none", policy, np.array(costs))


class Position(dlx.systems.DoubleIntegrator):
    """Without a sensor of the velocity."""

    def observe(self, t, x):
        return x[:1]


def hidden():
    dynamics = dlx.Discretized(Position(), dt=0.1)
    noise = dlx.disturbances.Gaussian(0.01, size=1)
    return dataclasses.replace(env(), dynamics=dynamics, sensor_noise=noise)


def test_a_policy_that_seldom_fails_is_better_than_one_that_never_works():
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    lqr, net = (dlx.controllers.Constant([float(i)]) for i in range(2))
    search.best = {}
    search.enter(known("network", net, *[2e3] * 10))
    search.enter(known("LQR", lqr, *[20.0] * 9, 3e7))
    assert search.chosen() == ("LQR", lqr)
    search.enter(known("network", net, *[20.0] * 9, np.inf))
    assert search.chosen() == ("LQR", lqr)
    search.enter(known("network", net, *[20.0] * 10))
    assert search.chosen() == ("network", net)


def test_the_last_choice_is_made_on_more_starts(monkeypatch):
    module = sys.modules[PolicySearch.__module__]
    # On the first starts the network is the better one, and on the others it is not.
    later = lambda _, __, policy, keys: np.full(len(keys), float(policy.value[0]))
    monkeypatch.setattr(module, "costs_of", later)
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    search.best = {}
    first = search.choice_keys[: module.CHOICE]
    for name, value in ("network", 3.0), ("LQR + network", 2.0), ("LQR", 4.0):
        policy = dlx.controllers.Constant([value])
        search.enter(known(name, policy, *np.full(len(first), 1.0 / value)))
    assert search.chosen()[0] == "LQR"
    search.choose()
    name, policy = search.chosen()
    assert name == "LQR + network" and policy.value == 2.0
    assert len(search.best[name].costs) == 8 * module.CHOICE


def test_the_last_choice_is_among_different_policies():
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    good, other = (dlx.controllers.Constant([float(i)]) for i in range(2))
    # Attempts without a gain enter the policy that they began with.
    for _ in range(5):
        search.enter(known("network", good, 1.0))
    search.enter(known("network", other, 2.0))
    assert [line.policy for line in search.finalists] == [good, other]


def test_a_reward_is_a_large_usual_cost():
    """Of a mountain car: zero control costs nothing, and a little effort little."""
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    for name, cost in ("zero", 0.0), ("LQR", 1e-5), ("network", -97.0):
        search.enter(known(name, dlx.controllers.Zero(1), cost, cost))
    assert search.usual == 97.0
    # The largest number is not too large for a small cost.
    assert np.isfinite(tamed(jnp.array([1.0, jnp.inf]), 1e-3)).all()


def test_a_constant_in_the_cost_does_not_hide_what_is_usual():
    """The median is zero by chance, and the spread of the costs is not."""
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    costs = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    search.enter(known("zero", dlx.controllers.Zero(1), *costs))
    assert search.usual == 2.0
    good, poor = (known("network", None, *(costs + more)) for more in (-0.5, 0.5))
    assert search.score(good) < search.score(poor)


def test_another_rate_is_another_program(monkeypatch):
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    line = known("network", dlx.controllers.Zero(1), 1.0)
    monkeypatch.setattr(PolicySearch, "trained", lambda *_: line.policy)
    slower = search.attempt(search.attempt(line, "gradient"), "evolution")
    monkeypatch.setattr(Budget, "spent", 6.0)
    search.budget.longest = 5.0
    assert search.may_begin(line, "gradient") and search.may_begin(slower, "evolution")
    assert not search.may_begin(slower, "gradient")


def test_each_kind_of_plant_gets_its_structures():
    lqr = dlx.controllers.local_lqr(env())
    names = lambda env, *given: set(structures(env, *given, 4, 1, KEY))
    assert names(env(), lqr, False) == {"LQR + network", "network"}
    assert names(env(), lqr, True) == {"LQR + memory", "network"}
    assert names(env(), None, True) == {"memory", "network"}
    assert names(hidden(), None, False) == {"memory"}
    noise = dlx.disturbances.Gaussian(0.01, size=2)
    noisy = dataclasses.replace(env(), sensor_noise=noise)
    lqg = local_lqg(noisy, key=KEY)
    assert names(noisy, lqg, False) == {"memory", "LQG + memory"}
    lqg = local_lqg(hidden(), key=KEY)
    assert names(hidden(), lqg, False) == {"memory", "LQG + memory"}


def test_an_lqg_may_be_enough():
    task = hidden()
    lqg = local_lqg(task, key=KEY)
    floor = {"zero": np.full(2, 9.0), "LQG": np.full(2, 1.0)}
    search = PolicySearch(task, None, KEY, 10.0, progress=False)
    for name, costs in floor.items():
        search.enter(known(name, lqg, *costs))
    assert search.chosen() == ("LQG", lqg)
    # A plan knows the velocity, so it cannot tell that the LQG is enough.
    search.law = lqg
    assert not search.is_settled()


def test_a_plant_that_cannot_rest_has_no_regulator():
    class Drifts(Position):
        def equilibrium(self):
            raise ValueError("no equilibrium")

        def vector_field(self, t, x, u, w):
            return jnp.array([x[1] ** 2 + 1.0, u[0]])

    dynamics = dlx.Discretized(Drifts(), dt=0.1)
    task = dataclasses.replace(hidden(), dynamics=dynamics, control_bounds=None)
    search = PolicySearch(task, None, KEY, 10.0, progress=False)
    words = "no LQG and no network around one .* only values from -2 to 2"
    with pytest.warns(UserWarning, match=words):
        assert search.regulator() is None


def test_a_policy_starts_with_the_costs_of_its_regulator(monkeypatch):
    """A round of training that harms an LQR leaves the LQR."""
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    lqr = dlx.controllers.local_lqr(env())
    policy = structures(env(), lqr, False, 4, 1, KEY)["LQR + network"]
    before = Candidate("LQR + network", "none", policy, search.costs(policy))
    np.testing.assert_allclose(before.costs, search.costs(lqr), rtol=1e-4)
    worse = dlx.controllers.Constant([100.0])
    monkeypatch.setattr(PolicySearch, "trained", lambda *_: worse)
    assert search.attempt(before, "gradient").policy is policy
    assert search.tried[-1].cost > search.mean(before)


def test_both_policies_run_in_the_same_programs():
    lqr = dlx.controllers.local_lqr(env())
    first, second = structures(env(), lqr, False, 4, 1, KEY).values()
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for one, other in zip(*map(jax.tree.leaves, (first, second)), strict=True):
        assert jax.typeof(one) == jax.typeof(other)
    network = simplified("network", second)
    assert isinstance(network, dlx.controllers.MLP)
    cost = lambda policy: dlx.rollout(env(), policy, key=KEY).total_cost
    np.testing.assert_allclose(cost(network), cost(second), rtol=1e-5)
    assert simplified("LQR", first) is first.base
    assert simplified("LQR + network", first) is first


def test_evolution_trains_weights_and_the_gradient_also_scales():
    policy = structures(env(), dlx.controllers.local_lqr(env()), False, 4, 1, KEY)
    policy = policy["LQR + network"]
    once_only = dict(key=KEY, callbacks=(lambda *_: True,))
    evolved = by_evolution(env(), None, policy, 0.3, 1.0, **once_only)
    trained = by_gradient(env(), None, policy, 0.5, 0.02, **once_only)
    scales = lambda made: (made.correction.bounds, made.correction.features.std)
    same = lambda a, b: all(map(np.array_equal, *map(jax.tree.leaves, (a, b))))
    for made, keeps_scales in (evolved, True), (trained, False):
        assert same(made.base, policy.base)
        assert not same(made.correction.network, policy.correction.network)
        assert same(scales(made), scales(policy)) == keeps_scales


def test_an_interrupt_keeps_the_rounds_so_far(monkeypatch):
    search = PolicySearch(env(), None, KEY, 1e4, progress=False)
    better, rounds = dlx.controllers.Constant([1.0]), []

    def trained(self, line, method):
        rounds.append(line)
        if len(rounds) > 1:
            raise KeyboardInterrupt
        return better

    monkeypatch.setattr(PolicySearch, "trained", trained)
    monkeypatch.setattr(PolicySearch, "costs", lambda *_: np.array([1.0]))
    worse = known("network", dlx.controllers.Zero(1), 2.0)
    with pytest.raises(KeyboardInterrupt):
        search.attempt(worse, "gradient")
    assert search.best["network"].policy is better


@pytest.mark.parametrize(("began", "blocks"), [(0.0, 6), (6.8, 2)])
def test_a_long_round_ends_with_its_time(monkeypatch, began, blocks):
    """After its first block a round takes 5% of the budget, or ends with the
    training, at 70% of it."""
    module = sys.modules[PolicySearch.__module__]
    heard = []

    def endless(*given, callbacks, **options):
        while not callbacks[0](len(heard), {}):
            heard.append(search.budget.spent)
        return given[2]

    monkeypatch.setattr(module, "by_gradient", endless)
    # A block takes 0.1 s.
    clock = lambda budget: began + 0.1 * len(heard)
    monkeypatch.setattr(Budget, "spent", property(clock))
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    line = known("network", dlx.controllers.Zero(1), 1.0)
    assert search.trained(line, "gradient") is line.policy
    assert len(heard) == blocks


def test_without_time_for_a_comparison_there_is_more_for_the_training(monkeypatch):
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    line = known("network", dlx.controllers.Zero(1), 1.0)
    monkeypatch.setattr(PolicySearch, "trained", lambda *_: line.policy)
    search.attempt(line, "gradient")
    monkeypatch.setattr(Budget, "spent", 8.0)
    search.budget.longest = 1.0
    assert not search.budget.may_train
    assert not search.may_begin(line, "gradient")
    # A plan would take until 12 s.
    search.budget.longest = 3.0
    assert search.budget.may_train
    assert search.may_begin(line, "gradient")
    # This one compiles first.
    assert not search.may_begin(line, "evolution")
    monkeypatch.setattr(Budget, "spent", 7.2)
    search.budget.longest = 2.7
    assert search.may_begin(line, "evolution")
    monkeypatch.setattr(Budget, "spent", 9.1)
    assert not search.budget.may_train


def test_derivatives_are_expected_to_take_longer_than_evolution(monkeypatch):
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    line = known("network", dlx.controllers.Zero(1), 1.0)
    monkeypatch.setattr(PolicySearch, "trained", lambda *_: line.policy)
    search.attempt(line, "evolution")
    search.budget.longest = 2.0
    monkeypatch.setattr(Budget, "spent", 6.9)
    # A gradient would take until 9.9 s, and a plan until 12.9 s.
    assert search.may_begin(line, "gradient")
    assert not search.budget.may_compare("plan", 6.9)
    monkeypatch.setattr(Budget, "spent", 7.1)
    assert not search.may_begin(line, "gradient")
    search.attempt(line, "gradient")
    search.budget.longest = 2.0
    assert search.budget.may_compare("plan", 6.9)


@pytest.mark.parametrize(
    ("task", "cost", "first"),
    [
        ("stick_slip", 0.5, ["evolution", "gradient", "gradient", "gradient"]),
        ("pendulum", 0.5, ["gradient", "gradient", "gradient", "gradient"]),
        # A gradient that changes nothing is zero, with any damping.
        ("pendulum", 1.0, ["gradient", "evolution"]),
    ],
)
def test_the_order_of_the_first_trainings(monkeypatch, task, cost, first):
    methods = []

    def recorded(self, line, method):
        methods.append(method.split(",")[0])
        self.tried.append(Attempt(line.structure, method, cost, 0.0))
        return line

    monkeypatch.setattr(PolicySearch, "attempt", recorded)
    monkeypatch.setattr(PolicySearch, "regulator", lambda self: None)
    monkeypatch.setattr(PolicySearch, "costs", lambda *_: np.ones(64))
    monkeypatch.setattr(PolicySearch, "refine", lambda *_: None)
    PolicySearch(dlx.make(task), None, KEY, 75.0, progress=False).run(4, 1)
    assert methods[: len(first)] == first
    assert len(methods) == (5 if cost < 1 else 2)


def test_a_state_that_diverges_costs_infinity():
    class Escapes(dlx.AbstractSystem):
        """The second state escapes, and the cost of the first does not show it."""

        state_names, control_names = ("x", "y"), ("u",)

        def vector_field(self, t, x, u, w):
            return jnp.stack([u[0] - x[0], jnp.exp(x[1])])

    cost = dlx.costs.Function(lambda t, x, u: x[0] ** 2)
    dynamics = dlx.Discretized(Escapes(), dt=0.1)
    task = dlx.Environment(dynamics, cost, initial_state=[1.0, 0.0], horizon=40)
    costs = costs_of(task, None, dlx.controllers.Zero(1), jax.random.split(KEY, 2))
    assert not np.isfinite(costs).any()


def test_a_comparison_ends_with_the_time(monkeypatch):
    module = sys.modules[PolicySearch.__module__]
    ran = []
    plan = lambda *given: ran.append(1) or jnp.zeros(len(given[-1]))
    monkeypatch.setattr(module, "costs_of_plan", plan)
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    keys = search.comparison_keys[: search.comparison_size]
    assert len(search.costs_of_rival("plan", None, keys)) == len(keys) == 16
    search.budget.began -= 12
    assert search.costs_of_rival("plan", None, keys) is None
    assert len(ran) == 4


def test_a_range_is_about_the_controls_of_the_law():
    applied = np.stack([np.linspace(40.0, 60.0, 101), np.full(101, 9.8)], axis=1)
    centre, spread = controls_of_a_law(np.vstack([applied, [np.nan, np.inf]]))
    np.testing.assert_allclose(centre, [50.0, 9.8])
    # The second control hardly varies, so it does not tell how large it may be.
    np.testing.assert_allclose(spread, [16 / 2.56, 1.0])


def test_a_range_reaches_from_a_bound_on_one_side():
    task = dataclasses.replace(env(), control_bounds=(jnp.array(5.0), jnp.inf))
    low, high = structures(task, None, False, 4, 1, KEY)["network"].correction.bounds
    assert low == 5 and 5 < high < jnp.inf


@pytest.mark.parametrize("better", [0.0, 0.1])
def test_it_ends_where_the_regulator_is_enough(monkeypatch, better):
    module = sys.modules[PolicySearch.__module__]
    monkeypatch.setattr(module, "costs_of_plan", lambda *_: np.ones(2) - better)
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    search.enter(known("LQR", dlx.controllers.Zero(1), 1.0, 1.0))
    assert search.is_settled() == (not better)
    # A rival that fails proves nothing.
    monkeypatch.setattr(module, "costs_of_plan", lambda *_: np.array([2.0, np.nan]))
    assert not search.is_settled()
    # Nor is it where the LQR fails and something else does not.
    search.best = {"LQR": known("LQR", dlx.controllers.Zero(1), 1.0, np.inf)}
    assert not search.is_settled()
    search.best = {"LQR": known("LQR", dlx.controllers.Zero(1), 1.0, 1.0)}
    search.enter(known("network", dlx.controllers.Zero(1), 0.9, 0.9))
    assert not search.is_settled()


@pytest.fixture
def any_rivals(monkeypatch):
    """MPC and plans that cost one, so that neither is compiled."""
    module = sys.modules[PolicySearch.__module__]
    for name in ("costs_of_mpc", "costs_of_plan"):
        monkeypatch.setattr(module, name, lambda *given: np.ones(len(given[-1])))


@pytest.mark.usefixtures("any_rivals")
def test_it_stops_where_the_user_does(monkeypatch):
    def interrupted(self, *_):
        raise KeyboardInterrupt

    monkeypatch.setattr(PolicySearch, "attempt", interrupted)
    stopped = synthesise(env(), key=KEY, width=8, progress=False)
    assert stopped.structure == "LQR" and stopped.ended == "interrupted"
    assert {attempt.method for attempt in stopped.tried} == {"none"}


@pytest.mark.usefixtures("any_rivals")
def test_an_interrupt_before_anything_is_known(monkeypatch):
    def interrupted(self, *_):
        raise KeyboardInterrupt

    monkeypatch.setattr(PolicySearch, "run", interrupted)
    stopped = synthesise(env(), key=KEY, budget=10.0, progress=False)
    assert stopped.structure == "zero" and np.all(np.isfinite(stopped.costs["zero"]))


@pytest.mark.usefixtures("any_rivals")
@pytest.mark.parametrize("part", ["choose", "costs_of_rival"])
def test_an_interrupt_at_the_end(monkeypatch, part):
    def interrupted(self, *_):
        raise KeyboardInterrupt

    monkeypatch.setattr(
        PolicySearch, "run", lambda self, *_: self.enter(self.best["zero"])
    )
    monkeypatch.setattr(PolicySearch, part, interrupted)
    stopped = synthesise(env(), key=KEY, budget=10.0, progress=False)
    assert stopped.structure == "zero" and len(stopped.costs["policy"])
    assert ("MPC" in stopped.costs) == (part == "choose")


class NoDerivative(dlx.AbstractSystem):
    state_names, control_names = ("x",), ("u",)

    def vector_field(self, t, x, u, w):
        shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
        return jax.pure_callback(lambda x: -x, shape, x, vmap_method="sequential") + u


def plain(system):
    dynamics = dlx.Discretized(system, dt=0.1)
    return dlx.Environment(dynamics, dlx.costs.Quadratic([1.0], [1.0]), horizon=5)


class InNumPy(dlx.AbstractSystem):
    state_names, control_names = ("x",), ("u",)

    def vector_field(self, t, x, u, w):
        return np.tanh(np.asarray(x)) + u


class Silent(dlx.AbstractSystem):
    state_names, control_names = ("x",), ("u",)

    def vector_field(self, t, x, u, w):
        raise NotImplementedError


@pytest.mark.parametrize("system", [NoDerivative(), InNumPy(), Silent()])
def test_a_model_without_derivative(system):
    with pytest.raises(ValueError, match="synthesise: .* that JAX can differentiate"):
        synthesise(plain(system), key=KEY)


def test_it_cannot_be_traced():
    task = env()
    with pytest.raises(ValueError, match="synthesise: .* cannot be called under"):
        jax.jit(lambda key: synthesise(task, key=key).seconds)(KEY)


def test_a_cost_that_stays_infinite(monkeypatch):
    costs = {"policy": np.array([1.0, np.inf])}
    zero = known("zero", dlx.controllers.Zero(1), 1.0, 1.0, np.inf)
    monkeypatch.setattr(PolicySearch, "run", lambda self, *_: self.enter(zero))
    monkeypatch.setattr(
        PolicySearch, "choose", lambda self: setattr(self, "best", {"zero": zero})
    )
    monkeypatch.setattr(PolicySearch, "compare", lambda *_: costs.items())
    with pytest.warns(UserWarning, match="'zero', which .* from 2 of the 5"):
        synthesise(env(), key=KEY, progress=False)


class NoEnd(dlx.costs.Quadratic):
    def final(self, t, x):
        return jnp.log(-jnp.sum(x**2))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (dict(initial_state=lambda key: jnp.full(2, jnp.nan)), "initial state must be"),
        (
            dict(cost=dlx.costs.Function(lambda t, x, u: jnp.log(-(x[0] ** 2)))),
            "cost of an initial state must be finite",
        ),
        (
            dict(cost=NoEnd([1.0, 1.0], [1.0])),
            "cost of an initial state must be finite",
        ),
        (
            dict(initial_state=lambda key: jnp.full(2, 3e38)),
            "cost of an initial state must be finite",
        ),
    ],
)
def test_bad_tasks(change, match):
    task = dataclasses.replace(env(), **change)
    with pytest.raises(ValueError, match=f"synthesise: the {match}"):
        synthesise(task, key=KEY)


def test_a_cost_may_be_infinite_at_zero_control():
    cost = dlx.costs.Function(lambda t, x, u: x[0] ** 2 - jnp.log(jnp.abs(u[0])))
    task = dataclasses.replace(env(), cost=cost, horizon=5)
    _check_environment(task, None, jax.random.split(KEY, 4))


def test_each_plant_of_a_family_is_checked():
    class Grows(dlx.AbstractSystem):
        state_names, control_names = ("x",), ("u",)
        rate: jax.Array = dlx.parameter(0.0)

        def vector_field(self, t, x, u, w):
            return jnp.exp(self.rate * x) + u

    task = dataclasses.replace(plain(Grows()), initial_state=[1.0])
    ranges = {"dynamics.system.rate": (800.0, 900.0)}
    with pytest.raises(ValueError, match="none of 16 controls keeps the first step"):
        synthesise(task, key=KEY, ranges=ranges)


def test_a_budget_that_is_over_before_the_training(monkeypatch):
    monkeypatch.setattr(Budget, "spent", 8.0)
    monkeypatch.setattr(PolicySearch, "attempt", lambda _, line, method: line)
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    with pytest.warns(UserWarning, match="a budget of 10 s is too small .* took 8 s"):
        search.run(4, 1)


def test_a_comparison_that_fails_does_not_lose_the_policy(monkeypatch):
    def fails(*_):
        raise RuntimeError("out of memory")

    module = sys.modules[PolicySearch.__module__]
    monkeypatch.setattr(module, "costs_of_mpc", fails)
    monkeypatch.setattr(module, "costs_of_plan", lambda *given: np.ones(4))
    search = PolicySearch(env(), None, KEY, 10.0, progress=False)
    with pytest.warns(UserWarning, match="no comparison with MPC: out of memory"):
        costs = dict(search.compare(dlx.controllers.Zero(1)))
    assert set(costs) == {"policy", "zero", "plan"}


def test_mpc_is_no_rival_without_the_state(monkeypatch):
    module = sys.modules[PolicySearch.__module__]
    for name in "costs_of_mpc", "costs_of_plan":
        monkeypatch.setattr(module, name, lambda *given: np.ones(4))
    noise = dlx.disturbances.Gaussian(0.01, size=2)
    noisy = dataclasses.replace(env(), sensor_noise=noise)
    rivals = {}
    for task in env(), noisy:
        search = PolicySearch(task, None, KEY, 10.0, progress=False)
        monkeypatch.setattr(search, "costs", lambda *_: np.ones(64))
        rivals[task is noisy] = set(dict(search.compare(dlx.controllers.Zero(1))))
    assert rivals[False] - rivals[True] == {"MPC"}


def test_starts_that_are_lost_are_named_before_the_training(monkeypatch):
    class Cubic(dlx.AbstractSystem):
        state_names, control_names = ("x",), ("u",)

        def vector_field(self, t, x, u, w):
            return x**3 + u

        def equilibrium(self):
            return jnp.zeros(1), jnp.zeros(1)

    def interrupted(self, *_):
        raise KeyboardInterrupt

    monkeypatch.setattr(PolicySearch, "attempt", interrupted)
    start = dlx.environments.UniformState([-4.0], [4.0])
    task = dataclasses.replace(
        plain(Cubic()), initial_state=start, control_bounds=(-1.0, 1.0), horizon=40
    )
    with pytest.warns(UserWarning) as warned:
        synthesise(task, key=KEY, budget=10.0, progress=False)
    words = r"not finite from \d+ of 64 initial states under zero control and the LQR"
    assert re.search(words, str(warned[0].message))


def test_a_start_that_no_control_keeps():
    class Explodes(dlx.AbstractSystem):
        state_names, control_names = ("x",), ("u",)

        def vector_field(self, t, x, u, w):
            return jnp.exp(x) + u

    task = dataclasses.replace(plain(Explodes()), initial_state=[200.0])
    with pytest.raises(ValueError, match="none of 16 controls keeps the first step"):
        synthesise(task, key=KEY)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (dict(budget=9.0), "budget must be at least 10 s"),
        (dict(budget=jnp.nan), "budget must be"),
        (dict(width=0), "width must be"),
        (dict(ranges={"dynamics.system.weight": (1, 2)}), "weight"),
        (dict(ranges={}), "ranges must name at least one parameter"),
    ],
)
def test_bad_arguments(options, match):
    with pytest.raises(ValueError, match=match):
        synthesise(env(), key=KEY, **options)
