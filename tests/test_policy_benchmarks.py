"""The parts of `python -m benchmarks.policies` count, judge and store as they say."""

import importlib
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from helpers import once


pytestmark = once

ROOT = Path(__file__).parents[1]


@pytest.fixture
def module(monkeypatch):
    """Imports a module of the benchmarks."""
    monkeypatch.syspath_prepend(str(ROOT))
    return lambda name: importlib.import_module(f"benchmarks.{name}")


@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity"), reason="threads are not bound to cores here"
)
def test_a_case_has_the_cores_that_its_benchmark_began_with(
    module, tmp_path, monkeypatch
):
    cases = module("_cases")
    (tmp_path / "tiny.py").write_text(
        "import os\n"
        "from benchmarks import _cases\n"
        "_cases.describe = lambda: {'cores_used': len(os.sched_getaffinity(0))}\n"
        "_cases.answer(lambda seed: {'seconds': 0.5})\n"
    )
    path = [str(tmp_path), str(ROOT), str(ROOT / "src")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    given: tuple = "tiny", tmp_path / "store.jsonl", [{"seed": 0}], str
    usable = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(usable)})
        (row,) = cases.run(*given)
        assert os.sched_getaffinity(0) == {min(usable)}
    finally:
        os.sched_setaffinity(0, usable)
    assert row["machine"]["cores_used"] == len(cases.CORES)
    assert (row["seed"], row["seconds"]) == (0, 0.5)


@pytest.fixture
def ran(module, monkeypatch):
    """The cases that were run, each of which gives the number of those before."""
    made = []

    def row(_, case):
        made.append(case)
        return case | {"count": len(made)}

    monkeypatch.setattr(module("_cases"), "_row", row)
    return made


def test_what_is_stored_runs_again_only_afresh(module, ran, tmp_path):
    cases, store = module("_cases"), tmp_path / "store.jsonl"
    both = [{"task": task, "seed": 0} for task in ("a", "b")]
    run = lambda which, **how: [
        row["count"] for row in cases.run("", store, which, str, **how)
    ]
    assert run(both) == run(both) == [1, 2]
    # What was not chosen is kept, and a row without a part of the case is another's.
    assert run(both[:1], fresh=True) == [3] and run(both) == [3, 2]
    assert run([both[1] | {"budget": 1.0}]) == [4] and run(both) == [3, 4]
    assert len(cases.stored(store)) == 3
    cases.forget(store, seed=0)
    assert cases.stored(store) == []


def test_a_case_of_the_ablation_has_its_budget(module, tmp_path, monkeypatch):
    ablation, costs = module("_ablation"), {"policy": [1.0], "zero": [2.0]}
    monkeypatch.setattr(ablation, "STORE", tmp_path / "store.jsonl")
    seen = []
    monkeypatch.setattr(
        ablation._cases,
        "_row",
        lambda _, case: (
            seen.append(case) or case | {"searches": [{"seed": 0, "costs": costs}]}
        ),
    )
    for budget in (1.0, 1.0, 2.0):
        monkeypatch.setattr(ablation, "BUDGET", budget)
        ablation.ablation(["pendulum"], seeds=1)
    count = len(ablation.WITHOUT)
    assert [case["budget"] for case in seen] == [1.0] * count + [2.0] * count


def row_of(task, seed=0, **costs) -> dict[str, Any]:
    """A row of the part `tasks`, on two starts."""
    each = {name: [float(cost)] * 2 for name, cost in costs.items()}
    about = {"structure": "network", "seconds": 1.0}
    return {"task": task, "seed": seed, "costs": each} | about


def test_regret_is_to_the_best_of_each_start(module):
    regret = module("_synthesis").regret
    row = row_of("pendulum", policy=3.0, zero=8.0)
    row["costs"]["plan"] = [2.0, 4.0]
    assert regret(row) == pytest.approx(6 / 5 - 1)
    assert regret(row, "zero") == pytest.approx(16 / 5 - 1)
    # A plan knows the disturbances of `lds`, and a reward is a negative cost.
    assert regret(row | {"task": "lds"}) == 0
    assert regret(row_of("pendulum", policy=-3.0, plan=-4.0)) == pytest.approx(0.25)
    assert regret(row_of("pendulum", policy=float("nan"), plan=1.0)) == float("inf")


def test_tasks_that_need_no_training_are_counted(module, monkeypatch):
    """By what the LQR, the LQG and no control cost, and not by what was returned."""
    synthesis = module("_synthesis")
    made = {
        "pendulum": dict(LQR=1.04),
        "cartpole": dict(LQR=1.06),
        "balloon_lung": dict(LQG=1.0),
        "cstr": dict(LQR=[1.0, 9.0, 9.0]),
    }
    rows = []
    for task, law in made.items():
        for seed in range(3):
            each = {k: v[seed] if isinstance(v, list) else v for k, v in law.items()}
            rows.append(row_of(task, seed, policy=1, zero=9, plan=1, **each))
    monkeypatch.setattr(synthesis, "run", lambda *_, **__: rows)
    (summary,) = synthesis.tasks([])["summary"]
    assert (summary["tasks"], summary["near"], summary["by LQR"]) == (4, 4, 2)


def test_the_ablation_shows_the_range_of_several_seeds(module):
    ablation, page = module("_ablation"), module("_policy_page")
    each = {ablation.ALL: (0, 0, 0), "no LQR": (0.3, 0.1, 0.2)}
    rows = [
        {
            "task": "pendulum",
            "without": name,
            "searches": [
                row_of("pendulum", seed, policy=1 + above)
                for seed, above in enumerate(of)
            ],
        }
        for name, of in each.items()
    ]
    (row,) = ablation.summary(rows)
    assert ablation.cell(row, "no LQR") == "+20.0% (+10.0% to +30.0%)"
    assert "| `pendulum` | 0.0 (0.0 to 0.0) | 20.0 (10.0 to 30.0) |" in page.parts(
        [row]
    )
    # Of one seed there is no range.
    first = [row | {"searches": row["searches"][:1]} for row in rows]
    (row,) = ablation.summary(first)
    assert page.parts([row]).endswith("| `pendulum` | 0.0 | 30.0 |\n")


@pytest.mark.filterwarnings("ignore:synthesise. a budget of 0 s is too small")
@pytest.mark.parametrize(
    "without, is_clipped, is_chosen",
    [
        ("no LQR", True, True),
        ("no clipping", False, True),
        ("no last choice", True, False),
    ],
)
def test_what_the_ablation_leaves_out(
    module, monkeypatch, without, is_clipped, is_chosen
):
    from delucax.training import ClippedSamples
    from delucax.training._synthesis import _budget, _policy_search, _rounds

    def train(environment, ranges, policy, *_, **__):
        used.append(_rounds.ClippedSamples)
        return policy

    search, used, chosen = _policy_search.PolicySearch, [], []
    monkeypatch.setattr(_policy_search, "by_gradient", train)
    monkeypatch.setattr(_policy_search, "by_evolution", train)
    monkeypatch.setattr(
        _policy_search, "costs_of", lambda *given: np.ones(len(given[-1]))
    )
    monkeypatch.setattr(search, "choose", lambda self: chosen.append(self))
    monkeypatch.setattr(_budget.Budget, "may_compare", lambda *_: False)
    case = module("_ablation").case("double_integrator", without, 1, budget=0.0)
    (found,) = case["searches"]
    assert {kind is ClippedSamples for kind in used} == {is_clipped}
    assert bool(chosen) == is_chosen
    assert ("LQR" in found["costs"]) == (without != "no LQR")


def test_a_gradient_that_is_not_clipped(module):
    ablation = module("_ablation")
    key, w = jax.random.key(0), jnp.ones(2)
    loss = lambda w, key: jnp.exp(9 * jax.random.normal(key)) * jnp.sum(w**2)
    value, gradient = ablation.MeanGradient(4)(loss, w, key)
    draws = [loss(w, k) for k in jax.random.split(key, 4)]
    np.testing.assert_allclose(value, np.mean(draws), rtol=1e-5)
    np.testing.assert_allclose(gradient, value * np.ones(2), rtol=1e-5)


def test_the_limits_of_the_swing_up_are_judged(module, capsys):
    policies = module("policies")
    rows = [
        {"method": "analytic", "seeds with 95 of 100": 10, "seconds": [5.1, 1.0]},
        {"method": "PPO, all seeds at once", "seeds with 95 of 100": 8, "seconds": [9]},
    ]
    assert [row["met"] for row in policies.judged(rows, 10)] == [True, False, True]
    assert capsys.readouterr().out.count("NOT met") == 1
    # Limits are those of ten seeds.
    rows[0] |= {"seeds with 95 of 100": 2, "seconds": [5.0]}
    rows[1] |= {"seeds with 95 of 100": 1}
    assert [row["met"] for row in policies.judged(rows, 2)] == [True, True, False]


def test_differences_of_an_exported_policy_do_not_cancel(module):
    off, costs = module("_exported_policies").off, np.array([1.0, -4.0, 0.0, np.inf])
    assert off(costs, costs) == 0
    assert off(costs + [0.1, -0.1, 0, 0], costs) == pytest.approx(0.1)
    assert np.isnan(off(costs + [np.nan, 0, 0, 0], costs))


def test_rivals_are_told_apart_by_all_pairs_of_seeds(module, capsys):
    rivals = module("_rivals")
    ours, theirs = (
        np.array([[1.0, 3.0], [2.0, 4.0]]),
        np.array([[4.0, 6.0], [3.0, 4.0]]),
    )
    row = rivals.beside(ours, theirs)
    assert (row["cost"], row["best seed"], row["worst seed"]) == (4.25, 3.5, 5.0)
    assert (row["ours less theirs"], row["low"], row["high"]) == (-1.75, -3.0, -0.5)
    other = rivals.beside(ours, theirs - 1)
    table = pd.DataFrame(
        {"task": "a", "method": name} | r
        for name, r in {"PPO": row, "SAC": other}.items()
    )
    rivals.judge(table)
    said = capsys.readouterr().out
    assert "synthesise is not told from SAC" in said and "better than 1 of 2" in said
    # A law without a seed is one row beside several.
    assert rivals.beside(ours, theirs[:1])["high"] == -2.0


def test_rivals_of_a_task(module, monkeypatch):
    rivals = module("_rivals")
    assert rivals.methods("pendulum") == ["PPO, published", "SAC, published"]
    assert rivals.methods("cart-pole") == [
        "PPO, published",
        "SAC, defaults",
        "PPO, normalised",
        "SAC, normalised",
    ]
    monkeypatch.setattr(rivals, "STARTS", 3)
    asked = []
    monkeypatch.setattr(rivals, "theirs", lambda *given: asked.append(given[1:]))
    rivals.case("cart-pole", "PPO, normalised", 0, seconds=1.0)
    assert asked == [("cart-pole", "PPO, normalised", 0, 1.0)]
    lqr = rivals.case("cart-pole", "LQR", 0)
    assert lqr["structure"] == "LQR" and len(lqr["costs"]) == 3
    assert np.all(np.isfinite(lqr["costs"]))


def test_the_best_of_a_task_has_the_range_of_its_trainings(module):
    made, scores = module("scoreboard"), module("_scores")
    each = {"zero": [9.0], "MPC": [1.03], "MLP": [1.2, 1.04, 1.1], "synthesise": [1.0]}
    costs = {
        ("pendulum", m): np.array([[c] * 2 for c in row]) for m, row in each.items()
    }
    board = scores.Board(costs, {})
    assert made.best_table(board).endswith(
        "synthesise +0.0%, MPC +3.0%, MLP +10% (4.0 to 20) |\n"
    )
    assert board.trainings("pendulum", "MLP") == 3 and board.best("pendulum") == 1
    assert board.excess("pendulum", "LQR") is None


def test_laws_that_know_the_plant_of_the_family(module, monkeypatch):
    """Other settings are other cases, and a plan costs no more than LQR."""
    family = module("_family")
    monkeypatch.setattr(family, "PAIRS", 3)
    monkeypatch.setattr(family, "TOGETHER", 3)
    laws = "LQR of each plant", family.MPC, family.PLAN
    settings = {"lookahead": 3, "iterations": 2}, {"iterations": 200}
    monkeypatch.setattr(family, "LAWS", laws)
    monkeypatch.setattr(family, "SETTINGS", dict(zip(laws[1:], settings, strict=True)))
    asked = []

    def run(name, store, cases, said, **how):
        asked.extend(cases)
        return [case | family.case(**case) for case in cases if case["seed"] == 0]

    monkeypatch.setattr(family, "TRAINED", ())
    monkeypatch.setattr(family._cases, "run", run)
    rows = family.family(seeds=1)["rows"]
    assert [row["law"] for row in rows] == [*laws]
    assert {"law": family.PLAN, "seed": 0, "iterations": 200} in asked
    cost = {row["law"]: row["median cost"] for row in rows}
    assert cost[family.PLAN] <= cost["LQR of each plant"]
    page = module("_policy_page").family(rows)
    assert page.count("\n") == 2 + len(laws)
    # What was stored before a law was added has no row of it.
    assert module("_policy_page").family(rows[:-1]).count("\n") == page.count("\n") - 1
