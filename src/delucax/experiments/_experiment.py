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
        """Give the mark the reason `what`, or give the experiment `what` the mark."""
        if isinstance(what, str):
            return dataclasses.replace(self, reason=what)
        made = as_experiment(what)
        return dataclasses.replace(made, marks=(*made.marks, self))


class Marks:
    """Makes the marks of `experiment.mark.slow`, and of any other name."""

    def __getattr__(self, name: str) -> _MarkDecorator:
        if name.startswith("_"):
            raise AttributeError(name)
        return _MarkDecorator(name)


@dataclasses.dataclass(frozen=True)
class Fixture:
    """A resource that cases use, made by a function; see `experiment.fixture`."""

    function: Callable
    scope: str
    axis: Axis | None


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A function to run, with its parameters, seeds, fixtures and marks.

    You make one with [`delucax.experiments.experiment`][]. Calling it calls the
    function.

    **Arguments:**

    - `function`: the function to run; see [`delucax.experiments.experiment`][].
    - `name`: the name of the experiment; by default the name of the function.
    - `axes`: the parameters; none by default.
    - `seeds`: the seeds; `(0,)` by default.
    - `marks`: the marks of all cases; none by default.
    - `fixtures`: a dictionary that maps names to fixtures, for fixtures that are not
        global variables in the module of the function; empty by default.

    !!! example

        ```python
        from delucax.experiments import experiment, run

        @experiment.parametrize("x", [1.0, 2.0, 3.0])
        def square(x):
            return x**2

        results = run(square, progress=False)
        [row["value"] for row in results.rows]
        ```

        ```text
        [1.0, 4.0, 9.0]
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
        # A frozen dataclass does not allow assignment.
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
        """The fixtures that the function uses, directly or indirectly, by name. Each
        fixture comes after the fixtures that it needs."""
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
        """The axes of its parameters, and then the axes of its fixtures."""
        own = ((f.axis, name) for name, f in self.used_fixtures().items())
        return (*self.axes, *(Axis((name,), a.params) for a, name in own if a))

    def cases(
        self, select: str = "", marks: str = "", slow: bool = False
    ) -> tuple[Case, ...]:
        """The cases that would run.

        **Arguments:**

        - `select`: words in the name of a case, joined by `and`, `or`, `not` and
            parentheses. The case of letters does not matter. All cases by default.
        - `marks`: names of marks, joined by `and`, `or`, `not` and parentheses. All
            cases by default.
        - `slow`: whether to include cases that are marked `slow`; `False` by default.
            Slow cases are also included if `marks` names the mark `slow`.

        **Raises:** `ValueError` if the function has no argument for a parameter, if an
        argument has no value, or if a value cannot be identified by its content.
        """
        self._check()
        where = self.name
        functions = [fixture.function for fixture in self.used_fixtures().values()]
        precise = bool(jax.config.jax_enable_x64)
        # What all cases share. The code of the experiment's own module counts even if
        # the module belongs to a library.
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
            for other in sorted(needs[name] & fixtures.keys()):
                if fixture.scope == "process" and fixtures[other].scope == "case":
                    raise ValueError(
                        f"{where}: fixture {name} has the scope 'process', so it "
                        f"cannot use fixture {other}, which ends with each case. Give "
                        f"{other} the scope 'process' too."
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
        """Raise an error if an argument of a function has no value."""
        for name, p in arguments_of(function).items():
            open_ended = p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
            if name not in given and p.default is p.empty and not open_ended:
                raise ValueError(
                    f"{self.name}: the argument {name!r} of {label} has no value: "
                    "parametrize it, make a fixture of that name, or give it a "
                    "default."
                )


class experiment:  # noqa: N801
    """Make an experiment from a function. `experiment.parametrize` works as in pytest.

    The function is called for each case, with the parameters and fixtures as arguments.
    The function must return a number, or a dictionary from names to numbers, strings or
    arrays. The arguments of the function decide how the function is called:

    - if the function has an argument `key`: it is traced, compiled, and called for all
        seeds at once by `vmap`, each with `jax.random.key(seed)`. Arrays, arrays in
        modules, and numbers among the parameters are traced, so that the function need
        not be compiled again for other values. A number that must be known when the
        function is traced (a horizon, a width) is static. To find out which numbers
        must be static, `experiment` first tries to trace all numbers. If this fails, it
        traces only floats, and if this fails too, it traces no numbers.
    - if the function has an argument `seed`: it is called once for each seed, without
        `jit`, and gets the seed as an integer. Use `seed` for code that cannot be
        traced, such as `fit`.
    - if the function has neither `key` nor `seed` as an argument: it is called once,
        without `jit`.

    **Arguments:**

    - `function`: the function.

    **Returns:** a [`delucax.experiments.Experiment`][].

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
        len(results.rows)  # 3 lengths, 2 gains, 4 seeds
        ```

        ```text
        24
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
        """Call the function with each of `values`.

        Stacked decorators give all combinations.

        **Arguments:**

        - `names`: the names of arguments, such as `"controller, environment"`, or a
            sequence of names.
        - `values`: a value for each case. With several names, each value is a tuple.
            Wrap a value in `experiment.param` to give it an id or marks.
        - `ids`: the ids of the values, or a function from a value to its id. By default
            a number or a string is its own id, the id of a function or a class is its
            name, and other values are numbered.

        **Raises:** `ValueError` if a name is given twice, or if values or ids do not
        fit the names.
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

        - `seeds`: a number of seeds, which count from 0, or the seeds themselves.

        **Raises:** `ValueError` if there are no seeds, or if they are not whole
        numbers, negative, or repeated.
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
        """Make a fixture from a function that returns a value, or yields it once.

        An experiment of the same module, or another fixture, gets this value for its
        argument with the name of the fixture. The code after the `yield` runs when the
        scope ends. The arguments of a fixture are parameters of the experiment or other
        fixtures. A fixture of the scope `"process"` can use only other fixtures of
        that scope.

        **Arguments:**

        - `function`: the function that makes the value.
        - `scope`: `"case"` (default) makes a value for each case. `"process"` makes one
            in each process for each combination of the parameters that it takes.
        - `params`: values of the fixture. Every case is run with each of them, and the
            function takes them as `param`. None by default.
        - `ids`: the ids of `params`, as in `parametrize`.

        **Raises:** `ValueError` if the scope is unknown.
        """
        check_choice(scope, ("case", "process"), "scope", "experiment.fixture")
        axis = None if params is None else axis_of("param", params, ids)
        make = lambda function: Fixture(function, scope, axis)
        return make if function is None else make(function)

    @staticmethod
    def use(**fixtures: Fixture) -> Callable[[Any], Experiment]:
        """Give an experiment fixtures that are not globals of its module.

        **Arguments:**

        - `**fixtures`: the fixtures, by the names of the arguments.
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

        - `*values`: one value for each name.
        - `id`: the id; that of `parametrize` by default.
        - `marks`: one mark or several marks; none by default.
        """
        marks = (marks,) if isinstance(marks, Mark) else tuple(marks)
        return Param(values, id, marks)


def as_experiment(what: Any) -> Experiment:
    """The experiment itself, or an experiment made from a function."""
    return what if isinstance(what, Experiment) else Experiment(what)


def arguments_of(function: Callable) -> Mapping[str, inspect.Parameter]:
    """The arguments of a function by name."""
    return inspect.signature(function).parameters
