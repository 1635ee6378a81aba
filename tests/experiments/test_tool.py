"""The experiment tool, in one process."""

import errno
import importlib
import json
import os
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from helpers import once, user_error

import delucax as dlx
from delucax import experiments
from delucax.experiments import experiment, Results
from delucax.experiments._fingerprint import fingerprint
from delucax.experiments._results import TIMES
from delucax.experiments._statistics import quantile
from delucax.experiments._store import Store


pytestmark = once
mark, param = experiment.mark, experiment.param


def values(results):
    return [row.get("value") for row in results.rows]


def timeless(results):
    """The rows without what differs between two runs of the same thing."""
    return json.dumps(
        [{k: v for k, v in row.items() if k not in TIMES} for row in results.rows]
    )


def quiet(made, **options):
    return experiments.run(made, progress=False, **options)


# What is parametrized


@experiment.parametrize("a, b", [(1, 2), param(3, 4, id="big"), (5, None)])
@experiment.parametrize("c", ["x", param("y", marks=mark.slow)], ids=str.upper)
def product(a, b, c):
    return f"{a}{b}{c}"


def test_products_ids_and_values():
    ids = [case.id for case in product.cases(slow=True)]
    assert ids == [
        *("product[1-2-X]", "product[1-2-Y]", "product[big-X]", "product[big-Y]"),
        *("product[5-None-X]", "product[5-None-Y]"),
    ]
    results = quiet(product)
    assert values(results) == ["12x", "34x", "5Nonex"]
    assert results.parameters == ("a", "b", "c")
    assert results.rows[1]["a"] == 3 and results.rows[2]["b"] is None
    assert product(1, 2, "z") == "12z"


@pytest.mark.parametrize(
    "select, marks, count",
    [
        ("", "", 3),
        ("BIG", "", 1),
        ("not (big or none)", "", 1),
        ("", "slow", 3),
        ("big", "not slow", 1),
        ("y and 1-2", "slow", 1),
    ],
)
def test_selection(select, marks, count):
    assert len(product.cases(select, marks)) == count


@pytest.mark.parametrize("wrong", ["a and", "(a", "a b", "or a", ")", "not"])
def test_an_expression_that_cannot_be_read(wrong):
    with user_error(match="select must be words joined by and, or, not"):
        product.cases(wrong)


# Fixtures

made = []


@experiment.fixture(scope="process")
def plant(length):
    made.append(length)
    yield {"length": length}
    made.append(-length)


@experiment.fixture
def tool(plant):
    made.append("tool")
    yield plant["length"] + 1
    made.append("done")


@experiment.fixture(params=[10, 20], ids=["ten", "twenty"])
def scale(param):
    return 2 * param


def test_fixtures_are_made_once_a_scope_and_let_go():
    made.clear()

    @experiment.parametrize("length", [1, 2])
    def use(tool, scale):
        return tool * scale

    results = quiet(use)
    assert [row["case"] for row in results.rows] == [
        *("use[1-ten]", "use[1-twenty]", "use[2-ten]", "use[2-twenty]"),
    ]
    assert values(results) == [40, 80, 60, 120]
    one, two = ["tool", "done"] * 2, ["tool", "done"] * 2
    assert made == [1, *one, 2, *two, -2, -1]


def test_a_fixture_given_by_name():
    @experiment.fixture
    def offset():
        return 5

    @experiment.use(offset=offset)
    def shifted(offset):
        return offset

    assert values(quiet(shifted)) == [5]


def test_a_fixture_that_cannot_be_let_go_harms_no_result():
    @experiment.fixture(scope="process")
    def camera():
        yield 1
        raise OSError("no such camera")

    @experiment.use(camera=camera)
    def look(camera):
        return camera

    with pytest.warns(UserWarning, match="look: a fixture .* OSError: no such camera"):
        assert values(quiet(look)) == [1]


# How the function is called


def test_numbers_are_traced_and_what_must_be_known_is_not():
    traced = []

    @experiment.parametrize("length", [0.9, 1.0, 1.1])
    @experiment.parametrize("horizon", [3, 4])
    @experiment.parametrize("kind", ["cost", "end"])
    @experiment.seeds(2)
    def cost(length, horizon, kind, key):
        path = length * jax.random.normal(key, (horizon,))
        traced.append(horizon)
        return path.sum() if kind == "cost" else path[-1]

    results = quiet(cost)
    assert len(results.rows) == 24 and not results.failed
    # Compiled for each horizon and kind, and for no length.
    assert sorted(traced) == [3, 3, 4, 4]
    keys = [jax.random.key(0), jax.random.key(1)]
    for row, key in zip(
        results.where(length=1.1, horizon=4, kind="cost").rows, keys, strict=True
    ):
        alone = 1.1 * np.sum(jax.random.normal(key, (4,)))
        np.testing.assert_allclose(row["value"], alone, rtol=1e-5)
    first = results.rows[0]
    assert first["compile_seconds"] > 0
    assert first["run_seconds"] > 0


def test_modules_are_traced_by_their_arrays():
    count = 0
    gains = [dlx.controllers.Linear(k * jnp.ones((1, 2))) for k in (1.0, 2.0)]

    @experiment.parametrize("controller", [*gains, dlx.controllers.Zero(1)])
    def act(controller, key):
        nonlocal count
        count += 1
        return controller(0.0, jnp.ones(2), controller.init())[0][0]

    results = quiet(act)
    assert values(results) == [-2.0, -4.0, 0.0] and count == 2
    assert [row["controller"] for row in results.rows] == [
        *("controller0", "controller1", "controller2"),
    ]


def test_with_a_seed_it_is_called_as_it_is():
    @experiment.seeds([3, 1])
    def plain(seed):
        return {"twice": 2 * seed, "kind": type(seed).__name__, "path": np.ones(2)}

    rows = quiet(plain).rows
    assert [row["seed"] for row in rows] == [3, 1]
    assert rows[0]["twice"] == 6 and rows[1]["path"] == [1.0, 1.0]
    assert {row["kind"] for row in rows} == {"int"}


def test_results_of_seeds_have_the_types_of_a_single_call():
    @experiment.seeds(2)
    def draw(key):
        x = jax.random.normal(key)
        return {"none": None, "pair": [x, 2 * x]}

    for row in quiet(draw).rows:
        x = row["pair"][0]
        assert row["pair"] == [x, 2 * x] and row["none"] is None and not row["error"]

    def nested(key):
        return {"inner": {"x": jax.random.normal(key)}}

    (row,) = quiet(experiment(nested)).rows
    assert "the result 'inner' must be a number, a string or an array" in row["error"]


def test_seeds_are_spread_over_a_mesh(tmp_path):
    mesh = jax.make_mesh((jax.device_count(),), ("seeds",))

    @experiment.seeds(2 * jax.device_count())
    def draw(key):
        return jax.random.normal(key)

    whole = values(quiet(draw, mesh=mesh))
    assert whole == values(quiet(draw))
    # The devices need not divide the seeds that are missing: all run again.
    path = tmp_path / "results.jsonl"
    quiet(draw, store=path, seeds=1)
    assert values(quiet(draw, store=path, mesh=mesh)) == whole
    assert json.loads(path.read_text().splitlines()[-1])["seeds"] == [
        *range(len(whole))
    ]


# Failures


def test_a_failing_case_harms_no_other():
    @experiment.parametrize(
        "n",
        [
            *(0, 1, 2, 3),
            param(4, marks=mark.xfail("known")),
            param(5, marks=mark.xfail),
            param(6, marks=mark.skip("no")),
        ],
    )
    def fragile(n):
        if n == 1:
            raise RuntimeError("one is bad")
        if n == 2:
            raise SystemExit(3)
        if n == 3:
            return object()
        return 1 // (4 - n)

    results = quiet(fragile)
    assert [row["status"] for row in results.rows] == [
        *("passed", "failed", "failed", "failed"),
        *("failed as expected", "passed unexpectedly", "skipped"),
    ]
    rows = results.rows
    assert rows[1]["error"] == "RuntimeError: one is bad"
    assert "in fragile" in rows[1]["traceback"]
    assert "SystemExit" in rows[2]["error"] and "must be a number" in rows[3]["error"]
    assert len(results.failed) == 4


def test_what_cannot_be_traced_fails_with_its_own_error():
    @experiment.parametrize("n", [1, 2])
    def wrong(n, key):
        raise ValueError(f"not {n}")

    assert [row["error"] for row in quiet(wrong).rows] == [
        *("ValueError: not 1", "ValueError: not 2"),
    ]


# The store


calls = []


@experiment.parametrize("x", [1.0, 2.0, 3.0])
@experiment.seeds(2)
def stored(x, seed):
    calls.append((x, seed))
    if x == 2.0:
        raise ValueError("two")
    return {"y": x / 3 + seed, "z": float("nan") if x == 3.0 else 1}


def ran(made, path, **options):
    calls.clear()
    results = quiet(made, store=path, **options)
    return results, list(calls)


def test_only_what_is_missing_is_run(tmp_path):
    path = tmp_path / "new" / "results.jsonl"
    first, done = ran(stored, path)
    assert len(done) == 5  # the second seed of what failed is not tried
    again, done = ran(stored, path)
    assert done == [] and timeless(again) == timeless(first)
    assert timeless(Results.read(path)) == timeless(first)
    _, done = ran(stored, path, retry=True)
    assert done == [(2.0, 0)]
    wider, done = ran(stored, path, seeds=3, select="not 2.0")
    assert done == [(1.0, 2), (3.0, 2)] and len(wider.rows) == 6
    _, done = ran(stored, path, fresh=True, select="1.0")
    assert done == [(1.0, 0), (1.0, 1)]


def test_a_change_of_code_or_values_runs_again(tmp_path):
    path = tmp_path / "results.jsonl"

    def build(factor, helper, values, fixture=1):
        @experiment.fixture
        def offset():
            return fixture

        @experiment.use(offset=offset)
        @experiment.parametrize("x", values, ids=["a", "b"])
        def changed(x, offset):
            calls.append(x)
            return factor * helper(x) + offset

        return changed

    def double(x):
        return 2 * x

    def triple(x):
        return 3 * x

    assert ran(build(1.0, double, [1, 2]), path)[1] == [1, 2]
    assert ran(build(1.0, double, [1, 2]), path)[1] == []
    assert ran(build(1.0, double, [1, 3]), path)[1] == [3]
    assert ran(build(2.0, double, [1, 3]), path)[1] == [1, 3]
    assert ran(build(2.0, triple, [1, 3]), path)[1] == [1, 3]
    assert ran(build(2.0, triple, [1, 3], fixture=2), path)[1] == [1, 3]
    results, done = ran(build(2.0, triple, [1, 3], fixture=2), path)
    assert done == [] and values(results) == [8.0, 20.0]


def test_what_a_class_inherits_and_a_module_imports_is_code_too(tmp_path, monkeypatch):
    first = {
        "deep": "def factor():\n    return 1\n",
        "base": "import deep\n\nclass Base:\n    def f(self):\n"
        "        return deep.factor()\n",
        "case": "from base import Base\n\nclass Mine(Base):\n    pass\n\n"
        "def run():\n    return Mine().f()\n",
    }
    found = []
    for k, change in enumerate(
        (
            None,
            None,
            ("deep", "return 1", "return 2"),
            ("base", "()", "() + 1"),
        )
    ):
        folder = tmp_path / str(k)
        folder.mkdir()
        for name, text in first.items():
            if change is not None and change[0] == name:
                text = text.replace(*change[1:])
            (folder / f"{name}.py").write_text(text)
        with monkeypatch.context() as patch:
            patch.syspath_prepend(folder)
            found.append(fingerprint(importlib.import_module("case").run))
        for name in first:
            del sys.modules[name]
    assert found[0] == found[1] and len(set(found)) == 3


def test_a_line_cut_short_is_run_again(tmp_path):
    path = tmp_path / "results.jsonl"
    whole, _ = ran(stored, path)
    content = path.read_bytes()
    # Anywhere at all, the header too.
    for end in (0, 7, *range(200, len(content), 97)):
        path.write_bytes(content[:end])
        again, _ = ran(stored, path)
        assert timeless(again) == timeless(whole)
        assert path.read_bytes().count(b"\n") >= 4
        json.loads(path.read_bytes().splitlines()[-1])


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="there is no such device")
def test_a_device_is_no_store():
    @experiment.parametrize("n", [1])
    def one(n):
        return n

    with user_error(match="is not a regular file"):
        experiments.run(one, store="/dev/zero", progress=False)


def test_a_full_disk_keeps_what_was_done(tmp_path, monkeypatch):
    path = tmp_path / "results.jsonl"
    write, room = os.write, 1500

    def full(file, content):
        nonlocal room
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = write(file, content[:room])
        room -= written
        return written

    monkeypatch.setattr(os, "write", full)
    with user_error(OSError, match="No space left.*results so far are kept"):
        ran(stored, path)
    monkeypatch.undo()
    kept = len(Results.read(path).rows)
    assert 0 < kept < 6
    results, done = ran(stored, path)
    assert len(results.rows) == 6 and len(done) < 5


def test_files_that_are_not_ours(tmp_path):
    path = tmp_path / "results.jsonl"
    path.write_text('{"format": "delucax-results", "version": 99}\n')
    with user_error(match="has format 99, and this version of delucax reads"):
        quiet(stored, store=path)
    assert path.read_text().count("\n") == 1  # left as it is
    for other in ("x,y\n1,2\n", '{"mine": 1}'):
        path.write_text(other)
        with user_error(match="is not a results file of delucax"):
            quiet(stored, store=path)
        assert path.read_text() == other
    with user_error(match="is a folder"):
        quiet(stored, store=tmp_path)
    with user_error(FileNotFoundError, match="there is no file"):
        Results.read(tmp_path / "none.jsonl")
    path.unlink()
    ran(stored, path)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:2], lines[2][:40] + "\n", *lines[3:]]))
    with user_error(match="line 3 of .* is damaged"):
        quiet(stored, store=path)


def test_two_runs_do_not_write_one_file(tmp_path):
    path = tmp_path / "results.jsonl"

    def nested():
        with user_error(match="is being written by another run"):
            ran(stored, path)
        return 1

    assert values(quiet(experiment(nested), store=path)) == [1]


def test_lines_that_another_run_wrote_meanwhile_are_kept(tmp_path):
    path = tmp_path / "results.jsonl"
    early = Store(path, "run")
    whole, _ = ran(stored, path)
    with user_error(match="was written by another run meanwhile"):
        early.open()
    assert timeless(Results.read(path)) == timeless(whole)


# Bad input


def use_x(x):
    return x


def use_key(x, key):
    return x


WRONG = {
    "a name twice": (
        lambda: experiment.parametrize("x, x", [(1, 2)])(use_x),
        "a name is given twice",
    ),
    "stacked twice": (
        lambda: experiment.parametrize("x", [1])(
            experiment.parametrize("x", [2])(use_x)
        ),
        "use_x: the parameter 'x' is given twice",
    ),
    "unknown": (
        lambda: quiet(experiment.parametrize("xx", [1])(use_x)),
        "has no argument 'xx'; did you mean 'x'",
    ),
    "without value": (
        lambda: quiet(experiment(use_x)),
        "the argument 'x' of use_x has no value: parametrize it",
    ),
    "wrong number": (
        lambda: experiment.parametrize("x, y", [(1, 2), (3,)])(use_x),
        "each value must have 2 parts, for x, y",
    ),
    "no values": (lambda: experiment.parametrize("x", [])(use_x), "must have a value"),
    "a string": (lambda: experiment.parametrize("x", "ab")(use_x), "must be a list"),
    "ids": (
        lambda: experiment.parametrize("x", [1, 2], ids=["a"])(use_x),
        "ids must be 2 strings",
    ),
    "the same id": (
        lambda: experiment.parametrize("x", [1, 2], ids=["a", "a"])(use_x),
        "the id 'a' is given twice",
    ),
    "no name": (lambda: experiment.parametrize("x-y", [1])(use_x), "names must be"),
    "reserved": (
        lambda: quiet(experiment.parametrize("seed", [1])(lambda seed: seed)),
        "no parameter can be called 'seed'",
    ),
    "not to be told apart": (
        lambda: quiet(experiment.parametrize("x", [(i for i in "ab")])(use_x)),
        "the parameter 'x' of case .* cannot be identified by its content",
    ),
    "seeds": (lambda: experiment.seeds(0)(use_x), "seeds must be a number"),
    "seeds twice": (lambda: experiment.seeds([1, 1])(use_x), "seeds must differ"),
    "seeds for nothing": (
        lambda: quiet(
            experiment.parametrize("x", [1])(experiment.seeds(2)(use_x)),
        ),
        "the function takes neither 'key' nor 'seed'",
    ),
    "scope": (
        lambda: experiment.fixture(use_x, scope="module"),
        "scope must be 'case' or 'process'",
    ),
    "no function": (lambda: experiment(3), "function must be a function"),
    "key and seed": (
        lambda: quiet(experiment(lambda key, seed: seed)),
        "the function takes both 'key' and 'seed'",
    ),
    "fixtures in a circle": (
        lambda: quiet(
            experiment.use(
                hen=experiment.fixture(lambda egg: egg),
                egg=experiment.fixture(lambda hen: hen),
            )(lambda hen: hen)
        ),
        "fixtures need each other: hen -> egg -> hen",
    ),
    "a fixture by seed": (
        lambda: quiet(experiment.use(x=experiment.fixture(lambda key: key))(use_x)),
        "fixture x cannot take 'key': it is made once for all seeds",
    ),
    "a fixture of the process by one of a case": (
        lambda: quiet(
            experiment.use(
                x=experiment.fixture(lambda tool: tool, scope="process"),
                tool=experiment.fixture(lambda: 1),
            )(use_x)
        ),
        "fixture x has the scope 'process', so it cannot use fixture tool",
    ),
    "no expression": (lambda: quiet(stored, select=3), "select must be a string"),
    "confidence": (
        lambda: experiments.compare(
            quiet(stored), by="x", baseline=1.0, metric="y", confidence=95
        ),
        "confidence must be between 0 and 1",
    ),
    "workers": (lambda: quiet(stored, workers=0), "workers"),
    "mesh": (
        lambda: quiet(stored, mesh=jax.make_mesh((jax.device_count(),), ("seeds",))),
        "mesh needs experiments that take a key",
    ),
    "backend": (
        lambda: quiet(stored, backend="mpi"),
        "backend must be .loky. or .dask.",
    ),
    "no experiment": (
        lambda: experiments.run(),
        "at least one experiment must be given",
    ),
    "one name": (
        lambda: experiments.run(stored, stored),
        "must have different names",
    ),
    "metric": (
        lambda: experiments.compare(quiet(stored), by="x", baseline=1.0),
        r"metric must be a result \(y, z\)",
    ),
    "baseline": (
        lambda: experiments.compare(quiet(stored), by="x", baseline=9, metric="y"),
        "baseline must be a value of 'x'",
    ),
    "parameter": (
        lambda: experiments.compare(quiet(stored), by="w", baseline=9, metric="y"),
        "by must be a parameter",
    ),
    "ending": (lambda: quiet(stored).export("a.xls"), "to must end in .csv"),
    "where": (
        lambda: quiet(stored).where(sed=0),
        "where: there is no column 'sed'; there are experiment, case, x, seed",
    ),
    "column": (
        lambda: quiet(stored).export("csv", columns=["nope"]),
        "there is no column 'nope'",
    ),
}


@pytest.mark.parametrize("call, message", WRONG.values(), ids=WRONG)
def test_wrong_arguments_are_named(call, message):
    with user_error(match=message):
        call()


@pytest.mark.parametrize("name", ["x", "status", "error", "jax"])
def test_a_result_that_would_hide_a_column_fails(name):
    @experiment.parametrize("x", [1])
    def clash(x):
        return {name: 1.0}

    assert f"cannot be called '{name}'" in quiet(clash).rows[0]["error"]


# Tables and statistics


def test_exports(tmp_path):
    results = quiet(stored)
    results.export(tmp_path / "a.csv")
    frame = pd.read_csv(tmp_path / "a.csv")
    assert len(frame) == 6 and frame["jax"].iloc[0] == jax.__version__
    np.testing.assert_array_equal(frame["y"], results.table["y"])
    results.export(tmp_path / "a.parquet")
    pd.testing.assert_frame_equal(
        pd.read_parquet(tmp_path / "a.parquet")[["x", "seed", "y"]],
        results.table[["x", "seed", "y"]],
    )
    mixed = quiet(experiment.parametrize("x", [1, "a", None, True])(lambda x: 1))
    mixed.export(tmp_path / "b.parquet")
    column = pd.read_parquet(tmp_path / "b.parquet")["x"].astype(object)
    assert column.where(column.notna(), None).tolist() == ["1", "a", None, "True"]
    markdown = results.export("markdown", columns=["x", "y"])
    assert markdown.splitlines()[2] == "| 1 | 0.3333 |"
    latex = results.export(tmp_path / "a.tex", columns=["case", "y"])
    assert r"stored[1.0] & 0.3333 \\" in latex and (tmp_path / "a.tex").exists()


def test_interquartile_mean():
    assert experiments.interquartile_mean(np.arange(8.0)) == 3.5
    assert experiments.interquartile_mean([7.0]) == 7.0
    # Of five, the second and fourth count by three quarters.
    expected = (0.75 * 2 + 3 + 0.75 * 4) / 2.5
    assert experiments.interquartile_mean([1, 2, 3, 4, np.inf]) == expected
    with_nan = [[1, 2, 3, np.nan], [1, 2, 3, 9]]
    found = experiments.interquartile_mean(with_nan, axis=1)
    np.testing.assert_array_equal(found, [np.nan, 2.5])
    assert np.isnan(experiments.interquartile_mean(with_nan))
    with user_error(match="at least one entry"):
        experiments.interquartile_mean([])


def test_paired_comparison():
    """Pairs share most of their noise, and the interval knows it."""
    rng = np.random.default_rng(0)
    noise, own = 10 * rng.normal(size=(3, 40)), rng.normal(size=(3, 40))

    @experiment.parametrize("plant", [0, 1, 2])
    @experiment.parametrize("method", ["a", "b"])
    @experiment.seeds(40)
    def cost(plant, method, seed):
        extra = 1.0 + 0.5 * own[plant, seed] if method == "b" else 0.0
        return 100 + noise[plant, seed] + extra

    table = experiments.compare(quiet(cost), by="method", baseline="a")
    b = table.loc["b"]
    assert b["difference_low"] < b["difference"] < b["difference_high"]
    assert 0.5 < b["difference_low"] and b["difference_high"] < 1.5
    assert b["low"] < b["iqm"] < b["high"] and b["high"] - b["low"] > 1.5
    assert b["pairs"] == 120 and b["below"] < 0.1
    assert table.loc["a", "difference"] == 0
    other = experiments.experiment(lambda: {"seconds": 1.0})
    both = experiments.run(cost, other, progress=False)
    assert experiments.compare(both, by="method", baseline="a").equals(table)
    ratio = experiments.compare(quiet(cost), by="method", baseline="a", ratio=True)
    assert abs(ratio.loc["b", "ratio"] - 1.01) < 0.005


def test_a_list_is_a_value_of_each_seed():
    @experiment.seeds(2)
    def both(key):
        return [jax.random.normal(key), jax.random.uniform(key)]

    rows = experiments.run(both, progress=False).rows
    for seed, row in enumerate(rows):
        key = jax.random.key(seed)
        expected = [jax.random.normal(key), jax.random.uniform(key)]
        np.testing.assert_allclose(row["value"], expected, rtol=1e-6)


def test_quantiles_beside_infinity():
    assert list(quantile([0, 1, 2, 3, np.inf], [0.25, 0.75, 0.8])) == [1, 3, np.inf]
    assert quantile([np.inf, np.inf], 0.5) == np.inf
    assert np.isnan(quantile([np.nan, 1.0], 0.5))
