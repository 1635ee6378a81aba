"""`python -m delucax`: the commands."""

import argparse
import contextlib
import importlib.util
import inspect
import subprocess
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ._extras import extra


_SUITES = {"scoreboard": "delucax.studies._scoreboard"}
"""Experiments that come with the library: their modules."""
_COMMANDS: list[tuple[Callable, str, str, tuple]] = []
"""The commands in display order: function, help, epilog, options."""


def _command(help: str, *options: tuple, more: str = "") -> Callable:
    """Make a command of a function that returns the exit status, by its name."""

    def register(call: Callable[..., int | None]) -> Callable:
        _COMMANDS.append((call, help, more, options))
        return call

    return register


def _option(
    name: str, help: str, default: Any = None, **settings: Any
) -> tuple[str, dict[str, Any]]:
    """The arguments of `add_argument`. A default is shown in the help, and determines
    the type."""
    if default is not None:
        settings |= {"default": default, "type": type(default)}
        help += " (default: %(default)s)"
    return name, {"help": help, **settings}


def _flag(name: str, help: str) -> tuple[str, dict[str, Any]]:
    return _option(name, help, action="store_true")


def _expression(flag: str, name: str, help: str) -> tuple[str, dict[str, Any]]:
    """The option of an expression that selects cases."""
    settings = {"help": f"{help} (default: all)", "default": ""}
    return flag, {"dest": name, "metavar": "EXPR", **settings}


_CACHE = (
    _option(
        "--cache",
        "folder where they are kept for later runs (default: that of "
        "JAX_COMPILATION_CACHE_DIR, or ~/.cache/delucax/programs)",
        metavar="DIR",
    ),
    _option(
        "--no-cache",
        "keep none, as with JAX_ENABLE_COMPILATION_CACHE=false",
        **{"dest": "is_kept", "action": "store_false"},
    ),
)


def main(arguments: list[str] | None = None) -> int:
    """The command line; the exit status is 1 if cases failed, 2 on wrong arguments."""
    options = vars(_parser().parse_args(arguments))
    call = options.pop("call")
    folder, is_kept = options.pop("cache", None), options.pop("is_kept", None)
    if is_kept is not None:
        # JAX is imported after the arguments are read, so that help is shown at once.
        from ._programs import forget_programs, keep_programs

        if is_kept:
            keep_programs(folder)
        else:
            forget_programs()
    try:
        return call(**options) or 0
    except (OSError, ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    is_module = Path(sys.argv[0]).parts[-2:] == ("delucax", "__main__.py")
    prog = "python -m delucax" if is_module else "delucax"
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Differentiable control in JAX.",
        epilog=f"{prog} COMMAND --help shows the options of a command.",
    )
    shown = f"delucax {version('delucax')}"
    parser.add_argument(
        "--version", action="version", version=shown, help="show the version"
    )
    parser.set_defaults(call=parser.print_help)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for call, help, more, command_options in _COMMANDS:
        added = commands.add_parser(
            call.__name__.removeprefix("_"),
            help=help,
            description=f"{help[0].upper()}{help[1:]}.",
            epilog=textwrap.dedent(more).strip() or None,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        added.set_defaults(call=call)
        for name, settings in command_options:
            added.add_argument(name, **settings)
        kept = added.add_argument_group("compiled programs")
        for name, settings in _CACHE:
            kept.add_argument(name, **settings)
    return parser


_FILE = "a Python file of experiments, a module, or a suite that `list` names"
_CASES = (
    _expression("-k", "select", "cases by name, such as 'lqr and not cartpole'"),
    _expression("-m", "marks", "cases by their marks"),
)


@_command(
    "swing a pendulum up, then reproduce the paper with fewer seeds (two minutes)",
    _option("--out", "folder to write to", default="demo"),
    _option("--seeds", "how many MLPs to train", default=2),
)
def _demo(out: str, seeds: int) -> None:
    from .studies import demo

    demo(out, seeds=seeds)


@_command(
    "regenerate the figures and tables of the Deluca paper, claim by claim",
    _option("name", "all, or some of these", nargs="+", metavar="NAME"),
    _option("--out", "folder to write to", default="paper"),
    _flag("--small", "fewer seeds and steps"),
    more="""
        names: all, oracle-complexity, policy-gradient, estimator-variance,
          wall-clock, ventilator, pendulum-shock, lq-perturbations

        The exit status is 1 if a claim does not hold.
        """,
)
def _reproduce(name: list[str], out: str, small: bool) -> int:
    from .studies import reproduce

    rows = reproduce(name, out, small=small)
    return 0 if all(row["holds"] for row in rows) else 1


@_command(
    "learn lungs from breaths, and controllers of a ventilator in them",
    _option("--out", "folder to write to, or go on in", default="lung"),
    _flag("--small", "two lungs, in a minute"),
    _option("--data", "breaths of the public data set, as CSV (default: simulated)"),
    _option("--seeds", "networks of each kind (default: 3, or 1 if --small)", type=int),
    _option("--sensor-delay", "of how many samples; holds for DATA too", default=2),
)
def _lung(out: str, **options: Any) -> None:
    from .studies import lung_study

    lung_study(out, **options)


@_command(
    "name the tasks, controllers and suites, or the cases of FILE",
    _option("file", f"{_FILE}; its cases are listed", nargs="?", metavar="FILE"),
    *_CASES,
)
def _list(file: str | None, select: str, marks: str) -> int | None:
    if file is None:
        return _list_names()
    from .experiments.commands import list_cases

    list_cases(file, _SUITES, select, marks)


def _list_names() -> None:
    """Print the names of tasks, controllers and suites."""
    from . import AbstractController, controllers, environments

    def makes_controller(member: Any) -> bool:
        is_function = inspect.isfunction(member)
        made = inspect.signature(member).return_annotation if is_function else member
        is_controller = inspect.isclass(made) and issubclass(made, AbstractController)
        return is_controller and not inspect.isabstract(member)

    members = vars(controllers).items()
    columns = {
        'Tasks, for delucax.make("...")': [
            name for name in environments.registered() if "/" not in name
        ],
        "Controllers, in delucax.controllers": sorted(
            (name for name, member in members if makes_controller(member)),
            key=str.lower,
        ),
        "Suites, for python -m delucax run ...": [*_SUITES],
    }
    for number, (title, names) in enumerate(columns.items()):
        print(f"\n{title}:" if number else f"{title}:")
        width = max(map(len, names)) + 2
        rows = -(-len(names) // max(1, 78 // width))
        for k in range(rows):
            row = "".join(name.ljust(width) for name in names[k::rows])
            print(f"  {row}".rstrip())


@_command(
    "run the experiments of FILE",
    _option("file", _FILE, metavar="FILE"),
    *_CASES,
    _flag("--slow", "also cases marked slow"),
    _option("--seeds", "how many seeds (default: as FILE says)", type=int),
    _option("--workers", "processes; -1 is one for each core", default=1),
    _option("--dask", "run on the Dask cluster of this scheduler", metavar="ADDRESS"),
    _option("--store", "results file (default: results/FILE.jsonl)"),
    _option("--html", "write a report with tables and figures", metavar="PAGE"),
    _flag("--fresh", "run also what is stored"),
    _flag("--retry", "run again what failed"),
    _option("--quiet", "show no progress", dest="progress", action="store_false"),
    more="""
        examples:
          python -m delucax run sweep.py --workers 2
          python -m delucax run sweep.py -k "lqr and not cartpole" --seeds 32
          python -m delucax run scoreboard --html scoreboard.html

        Results are stored as they arrive; the same command goes on where it was
        stopped, and runs again only what changed.
        """,
)
def _run(
    file: str, store: str | None, html: str | None, dask: str | None, **options: Any
) -> int:
    from .experiments.commands import run_file

    with contextlib.ExitStack() as stack:
        if dask is not None:
            distributed = extra("distributed", "dask")
            stack.enter_context(distributed.Client(dask, timeout=20))
            options["backend"] = "dask"
        return run_file(file, _SUITES, store, html, options)


@_command(
    "show a results file, or what differs between two",
    _option("results", "results file", nargs="+", metavar="RESULTS"),
    _flag("--diff", "compare two, with paired 95%% intervals"),
    _option("--html", "write a report with tables and figures", metavar="PAGE"),
    _option(
        "--export",
        "write all rows to a .csv, .parquet, .md or .tex file",
        **{"action": "append", "metavar": "TABLE"},
    ),
    _expression("-k", "select", "only these cases"),
    more="""
        examples:
          python -m delucax report results/sweep.jsonl --html sweep.html
          python -m delucax report results/sweep.jsonl --export sweep.tex
          python -m delucax report --diff before.jsonl after.jsonl
        """,
)
def _report(
    results: list[str], diff: bool, html: str | None, export: list | None, select: str
) -> None:
    from .experiments.commands import report_diff, report_file

    report = report_diff if diff else report_file
    report(results, select, html, export or [])


@_command(
    "measure speed against other libraries, in a checkout",
    _option("name", "one benchmark, such as pendulum (default: all)", nargs="?"),
)
def _bench(name: str | None) -> int:
    sys.path.insert(0, str(Path.cwd()))
    if importlib.util.find_spec("benchmarks") is None:
        raise ValueError("bench: the benchmarks are in the repository: run this there.")
    module = "benchmarks" if name is None else f"benchmarks.{name}"
    if importlib.util.find_spec(module) is None:
        raise ValueError(f"bench: there is no benchmark called {name!r}.")
    return subprocess.run([sys.executable, "-u", "-m", module]).returncode


if __name__ == "__main__":
    sys.exit(main())
