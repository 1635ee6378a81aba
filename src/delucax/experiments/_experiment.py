"""Experiments, declared as pytest declares tests: a function and its arguments."""

import dataclasses
import inspect
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax

from .._check import check_choice, check_function
from .._message import did_you_mean
from .._provenance import version
from ._cases import as_seeds, Axis, axis_of, Case, Mark, Param, selector, words
from ._fingerprint import fingerprint
from ._store import RESERVED


class _MarkDecorator(Mark):
    def __call__(self, what: Any) -> Any:
        """The mark with the reason `what`, or the experiment `what` with the mark."""
        if isinstance(what, str):
            return dataclasses.replace(self, reason=what)
        made = as_experiment(what)
        return dataclasses.replace(made, marks=(*made.marks, self))


class Marks:
    """`experiment.mark.slow`, and any other name."""

    def __getattr__(self, name: str) -> _MarkDecorator:
        if name.startswith("_"):
            raise AttributeError(name)
        return _MarkDecorator(name)


@dataclasses.dataclass(frozen=True)
class Fixture:
    """A resource of cases, made by a function; see `experiment.fixture`."""

    function: Callable
    scope: str
    axis: Axis | None


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A function with its parameters, seeds, fixtures and marks; made by
    [`delucax.experiments.experiment`][].

    Calling it calls the function.

    **Arguments:**

    - `function`: what to run, see [`delucax.experiments.experiment`][].
    - `name`: the function's by default.
    - `axes`: the parameters; none by default.
    - `seeds`: the seeds; 0 alone by default.
    - `marks`: of all cases; none by default.
    - `fixtures`: by name, those that are not globals of the function; none by default.

    !!! example

        ```python
        from delucax.experiments import experiment, run

        @experiment.parametrize("x", [1.0, 2.0, 3.0])
        def square(x):
            return x**2

        results = run(square, progress=False)
        assert [row["value"] for row in results.rows] == [1.0, 4.0, 9.0]
        ```
    """

    function: Callable
    name: str = ""
    axes: tuple[Axis, ...] = ()
    seeds: tuple[int, ...] = (0,)
    marks: tuple[Mark, ...] = ()
    fixtures: Mapping[str, Fixture] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        f = self.function
        check_function(f, "function", "experiment")
        name = self.name or getattr(f, "__name__", type(f).__name__)
        own = {n: getattr(f, n, None) for n in ("__doc__", "__module__")}
        # A frozen dataclass takes no assignment.
        vars(self).update(own, name=name, __wrapped__=f)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function."""
        return self.function(*args, **kwargs)

    @property
    def arguments(self) -> Mapping[str, inspect.Parameter]:
        """The arguments of the function."""
        return arguments_of(self.function)

    @property
    def is_random(self) -> bool:
        """Whether the function takes a key or a seed."""
        return not {"key", "seed"}.isdisjoint(self.arguments)

    def used_fixtures(self) -> dict[str, Fixture]:
        """The fixtures that it uses, directly or through others, by name; each after
        those that it needs itself."""
        used: dict[str, Fixture] = {}
        known = {**getattr(self.function, "__globals__", {}), **self.fixtures}
        given = {name for axis in self.axes for name in axis.names}

        def visit(function: Callable, path: tuple[str, ...]) -> None:
            for name in arguments_of(function):
                fixture = known.get(name)
                if name in given or not isinstance(fixture, Fixture):
                    continue
                if name in path:
                    loop = " -> ".join((*path, name))
                    raise ValueError(f"{self.name}: fixtures need each other: {loop}.")
                visit(fixture.function, (*path, name))
                used[name] = fixture

        visit(self.function, ())
        return used

    def all_axes(self) -> tuple[Axis, ...]:
        """The axes, those of its fixtures last."""
        own = ((f.axis, name) for name, f in self.used_fixtures().items())
        return (*self.axes, *(Axis((name,), a.params) for a, name in own if a))

    def cases(
        self, select: str = "", marks: str = "", slow: bool = False
    ) -> tuple[Case, ...]:
        """The cases that would run.

        **Arguments:**

        - `select`: words that occur in the case's name, joined by `and`, `or`, `not`
            and parentheses; case does not matter. All by default.
        - `marks`: likewise, of the names of its marks.
        - `slow`: whether those marked `slow` are among them; not by default, unless
            `marks` names the mark.

        **Raises:** `ValueError` on a parameter that the function does not have, an
        argument without a value, or a value that cannot be told from others by its
        content.
        """
        self._check()
        where = self.name
        functions = [fixture.function for fixture in self.used_fixtures().values()]
        precise = bool(jax.config.jax_enable_x64)
        # What all cases share. The experiment's own module counts also in a library.
        content = [self.function, functions, precise, version("delucax")]
        code = fingerprint(content, root=getattr(self.function, "__module__", None))
        is_selected = selector(select, "select", where)
        is_marked = selector(marks, "marks", where)
        slow = slow or "slow" in words(marks)
        choices = [axis.choices(where) for axis in self.all_axes()]
        cases, names = [], set()
        for chosen in itertools.product(*choices):
            ids = "-".join(str(choice.param.id) for choice in chosen)
            case = Case(
                experiment=self.name,
                id=f"{self.name}[{ids}]" if chosen else self.name,
                index=tuple(choice.index for choice in chosen),
                shown={k: v for choice in chosen for k, v in choice.shown.items()},
                marks=self.marks + tuple(m for c in chosen for m in c.param.marks),
                hash=fingerprint("-".join([code, *(c.hash for c in chosen)])),
            )
            if case.id in names:
                raise ValueError(
                    f"{where}: two cases are called {case.id!r}; give other ids."
                )
            names.add(case.id)
            is_wanted = slow or not case.mark("slow")
            if is_wanted and is_selected(case.matches) and is_marked(case.mark):
                cases.append(case)
        return tuple(cases)

    def _check(self) -> None:
        where, arguments, fixtures = self.name, self.arguments, self.used_fixtures()
        needs = {name: {*arguments_of(f.function)} for name, f in fixtures.items()}
        taken = {*arguments}.union(*(names - {"param"} for names in needs.values()))
        names = [name for axis in self.axes for name in axis.names]
        any_name = any(p.kind is p.VAR_KEYWORD for p in arguments.values())
        for name in names:
            if name in RESERVED or name == "key":
                raise ValueError(f"{where}: no parameter can be called {name!r}.")
            if name not in taken and not any_name:
                hint = did_you_mean(name, sorted(taken))
                raise ValueError(
                    f"{where}: the function has no argument {name!r}; {hint}"
                )
        given = {*names, *fixtures}
        self._check_given(self.function, where, {*given, "key", "seed"})
        for name, fixture in fixtures.items():
            for random in sorted({"key", "seed"} & needs[name]):
                raise ValueError(
                    f"{where}: fixture {name} cannot take {random!r}: it is made once "
                    "for all seeds."
                )
            self._check_given(fixture.function, f"fixture {name}", {*given, "param"})
        if {"key", "seed"} <= {*arguments}:
            raise ValueError(f"{where}: the function takes both 'key' and 'seed'.")
        if len(self.seeds) > 1 and not self.is_random:
            raise ValueError(
                f"{where}: it has {len(self.seeds)} seeds, but the function takes "
                "neither 'key' nor 'seed'."
            )

    def _check_given(self, function: Callable, label: str, given: set[str]) -> None:
        """Raise where an argument of a function has no value."""
        for name, p in arguments_of(function).items():
            open_ended = p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
            if name not in given and p.default is p.empty and not open_ended:
                raise ValueError(
                    f"{self.name}: the argument {name!r} of {label} has no value: "
                    "parametrize it, make a fixture of that name, or give it a "
                    "default."
                )


class experiment:  # noqa: N801
    """Make an experiment of a function, with decorators in the manner of pytest.

    The function is called once for each case, with its parameters and fixtures as
    arguments, and returns a number, or a dictionary of names to numbers, strings or
    arrays. How it is called follows from its arguments:

    - with `key`: it is traced, compiled, and called for all seeds at once by `vmap`,
      each with `jax.random.key(seed)`. Parameters that are arrays, modules' arrays or
      numbers are traced, so that other values compile nothing again; where a number
      must be known when it is traced (a horizon, a width), it is static: tracing is
      tried first with all numbers, then with fewer.
    - with `seed`: it is called without `jit`, once for each seed, with an integer. For
      code that cannot be traced, such as `fit`.
    - with neither: it is called once, without `jit`.

    **Arguments:**

    - `function`: the function.

    **Returns:** an [`delucax.experiments.Experiment`][].

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.experiments import experiment, run

        @experiment.parametrize("length", [0.8, 1.0, 1.2])
        @experiment.parametrize("gain", [10.0, 20.0], ids=["weak", "strong"])
        @experiment.seeds(4)
        def cost(length, gain, key):
            env = dlx.make("pendulum", length=length)
            controller = dlx.controllers.Linear(jnp.stack([jnp.stack([gain, 5.0])]))
            return dlx.rollout(env, controller, key=key, horizon=10).total_cost

        results = run(cost, progress=False)
        assert len(results.rows) == 24
        ```
    """

    mark = Marks()

    def __new__(cls, function: Callable) -> Experiment:
        return as_experiment(function)

    @staticmethod
    def parametrize(
        names: str | Sequence[str],
        values: Iterable,
        *,
        ids: Sequence[str] | Callable[[Any], str] | None = None,
    ) -> Callable[[Any], Experiment]:
        """Call the function with each of `values`; stacked, with all combinations.

        **Arguments:**

        - `names`: of the arguments, `"controller, environment"` or a sequence.
        - `values`: one for each case; a tuple each if there are several names. Wrap one
            in `experiment.param` to give it an id or marks.
        - `ids`: what to call them, or a function from a value to that; by default
            numbers and strings are their own, functions and classes their names.

        **Raises:** `ValueError` on a name that is given twice, or if values or ids do
        not fit the names.
        """
        axis = axis_of(names, values, ids)

        def decorate(what: Any) -> Experiment:
            made = as_experiment(what)
            twice = {n for a in made.axes for n in a.names} & {*axis.names}
            if twice:
                raise ValueError(
                    f"{made.name}: the parameter {sorted(twice)[0]!r} is given twice."
                )
            return dataclasses.replace(made, axes=(axis, *made.axes))

        return decorate

    @staticmethod
    def seeds(seeds: int | Iterable[int]) -> Callable[[Any], Experiment]:
        """Run each case with these seeds.

        **Arguments:**

        - `seeds`: how many, from 0 on; or which.

        **Raises:** `ValueError` if they are no whole numbers, negative, or repeated.
        """
        chosen = as_seeds(seeds, "experiment.seeds")
        return lambda what: dataclasses.replace(as_experiment(what), seeds=chosen)

    @staticmethod
    def fixture(
        function: Callable | None = None,
        *,
        scope: str = "case",
        params: Iterable | None = None,
        ids: Sequence[str] | Callable[[Any], str] | None = None,
    ) -> Any:
        """Make a fixture: what a function returns, or yields once, is the argument of
        its name in experiments of the same module, and in other fixtures.

        What comes after the `yield` is run when the scope ends. Arguments of a fixture
        are parameters of the experiment or other fixtures.

        **Arguments:**

        - `function`: what makes it.
        - `scope`: `"case"` (default), made for each case; `"process"`, once in each
            process for each value of the parameters that it takes.
        - `params`: values to run every case with; the function takes them as `param`.
        - `ids`: what to call `params`.

        **Raises:** `ValueError` on another scope.
        """
        check_choice(scope, ("case", "process"), "scope", "experiment.fixture")
        axis = None if params is None else axis_of("param", params, ids)
        make = lambda function: Fixture(function, scope, axis)
        return make if function is None else make(function)

    @staticmethod
    def use(**fixtures: Fixture) -> Callable[[Any], Experiment]:
        """Give an experiment fixtures that are not globals of its module.

        **Arguments:**

        - `**fixtures`: by the name of the argument.
        """

        def decorate(what: Any) -> Experiment:
            made = as_experiment(what)
            return dataclasses.replace(made, fixtures={**made.fixtures, **fixtures})

        return decorate

    @staticmethod
    def param(
        *values: Any, id: str | None = None, marks: Mark | Sequence[Mark] = ()
    ) -> Param:
        """One of the values of `parametrize`, with an id and marks.

        **Arguments:**

        - `*values`: one for each name.
        - `id`: what to call it; as `parametrize` does by default.
        - `marks`: one mark or several; none by default.
        """
        marks = (marks,) if isinstance(marks, Mark) else tuple(marks)
        return Param(values, id, marks)


def as_experiment(what: Any) -> Experiment:
    """The experiment, or one made of a function."""
    return what if isinstance(what, Experiment) else Experiment(what)


def arguments_of(function: Callable) -> Mapping[str, inspect.Parameter]:
    """The arguments of a function by name."""
    return inspect.signature(function).parameters
