"""What marks make of a case, also after they changed."""

import pytest
from helpers import once, user_error

from delucax import experiments
from delucax.experiments import experiment, Results


pytestmark = once
mark, param = experiment.mark, experiment.param


calls = []


def square(path, *marks, **options):
    calls.clear()  # it is code that the cases name

    @experiment.parametrize("x", [1, param(2, marks=marks)])
    @experiment.seeds(2)
    def squared(x, seed):
        calls.append((x, seed))
        if x == 2:
            raise ValueError("two")
        return x**2

    return experiments.run(squared, store=path, progress=False, **options)


def states(results):
    return [row["status"] for row in results.rows]


def test_a_failure_counts_when_its_mark_is_gone(tmp_path):
    path = tmp_path / "results.jsonl"
    expected = square(path, mark.xfail("known"))
    assert states(expected) == ["passed"] * 2 + ["failed as expected"] * 2
    assert expected.failed == []
    now = square(path)
    assert calls == [] and states(now) == ["passed"] * 2 + ["failed"] * 2
    assert len(now.failed) == 2 and now.rows[2]["error"] == "ValueError: two"
    assert states(Results.read(path)) == states(now)
    size = path.stat().st_size
    square(path)
    assert path.stat().st_size == size  # nothing to say
    assert states(square(path, mark.xfail)) == states(expected)


def test_what_was_expected_to_fail_is_tried_again(tmp_path):
    path = tmp_path / "results.jsonl"
    square(path, mark.xfail)
    square(path, mark.xfail, retry=True)
    assert calls == [(2, 0)]


def test_a_pass_is_judged_again_for_the_seeds_that_are_there(tmp_path):
    def run(*marks, **options):
        @experiment.parametrize("x", [param(1, marks=marks)])
        @experiment.seeds(2)
        def same(x, seed):
            return {"y": [x, seed]}

        path = tmp_path / "results.jsonl"
        return experiments.run(same, store=path, progress=False, **options)

    run()
    more = run(mark.xfail, seeds=3)
    assert states(more) == ["passed unexpectedly"] * 3 and len(more.failed) == 3
    assert [row["y"] for row in more.rows] == [[1, 0], [1, 1], [1, 2]]
    assert states(run(seeds=[1])) == ["passed"]
    assert [row["y"] for row in run(seeds=[2, 1]).rows] == [[1, 2], [1, 1]]


def test_what_is_skipped_has_a_row_and_no_line(tmp_path):
    path = tmp_path / "results.jsonl"
    skipped = square(path, mark.skip("no"))
    assert states(skipped) == ["passed"] * 2 + ["skipped"] * 2
    assert skipped.rows[3]["x"] == 2 and skipped.rows[3]["seed"] == 1
    assert "skipped" in skipped.export("markdown") and skipped.failed == []
    assert states(Results.read(path)) == ["passed"] * 2
    experiments.report(skipped, tmp_path / "page.html")
    assert "1 passed, 1 skipped" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize("marks, count", [("(slow)", 1), ("(slow or fast)", 2)])
def test_marks_in_parentheses(marks, count):
    values = [1, param(2, marks=mark.slow), param(3, marks=mark.fast)]
    made = experiment.parametrize("x", values)(lambda x: x)
    assert len(made.cases(marks=marks)) == count


@pytest.mark.parametrize("values", [[param(1, id="a")] * 2, ["a", param(1, id="a")]])
def test_an_id_that_is_given_twice(values):
    with user_error(match="the id 'a' is given twice"):
        experiment.parametrize("x", values)


def test_a_mark_of_a_whole_experiment():
    @mark.skip("all of it")
    @experiment.parametrize("x", [1, 2])
    def never(x):
        raise AssertionError

    assert states(experiments.run(never, progress=False)) == ["skipped"] * 2


def test_an_experiment_that_takes_any_argument():
    @experiment.parametrize("a, b", [(1, 2)])
    def total(**values):
        return sum(values.values())

    assert [row["value"] for row in experiments.run(total, progress=False).rows] == [3]
