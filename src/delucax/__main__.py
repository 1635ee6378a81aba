"""`python -m delucax`: the commands."""

import argparse
import contextlib
import importlib
import importlib.util
import inspect
import pkgutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
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


def _whole_number(text: str) -> int:
    """An argument that is a whole number."""
    try:
        return int(text)
    except ValueError:
        words = f"expected a whole number, got {text!r}"
        raise argparse.ArgumentTypeError(words) from None


def _option(
    name: str, help: str, default: Any = None, **settings: Any
) -> tuple[str, dict[str, Any]]:
    """The arguments of `add_argument`. A default is shown in the help, and determines
    the type."""
    if default is not None:
        settings = {"default": default, "type": type(default)} | settings
        help += " (default: %(default)s)"
    return name, {"help": help, **settings}


def _number(
    name: str, help: str, default: int | None = None
) -> tuple[str, dict[str, Any]]:
    return _option(name, help, default, type=_whole_number, metavar="N")


def _flag(name: str, help: str, **settings: Any) -> tuple[str, dict[str, Any]]:
    settings = {"action": "store_true"} | settings
    return _option(name, f"{help} (default: off)", **settings)


def _expression(flag: str, name: str, help: str) -> tuple[str, dict[str, Any]]:
    """The option of an expression that selects cases."""
    settings = {"help": f"{help} (default: all of them)", "default": ""}
    return flag, {"dest": name, "metavar": "EXPR", **settings}


_CACHE = (
    _option(
        "--cache",
        "folder that keeps compiled programs, so that the next run starts sooner "
        "(default: the folder in JAX_COMPILATION_CACHE_DIR if it is set, else "
        "~/.cache/delucax/programs)",
        metavar="DIR",
    ),
    _option(
        "--no-cache",
        "do not keep compiled programs on disk (default: they are kept, unless "
        "JAX_ENABLE_COMPILATION_CACHE is false)",
        dest="is_kept",
        action="store_false",
    ),
)


def main(arguments: list[str] | None = None) -> int:
    """The command line. The exit status is 1 if a case failed or a claim does not hold,
    2 on wrong arguments, and 130 after Ctrl-C."""
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
    except FileNotFoundError as error:
        missing = f"there is no file '{error.filename}'."
        print(f"error: {missing if error.filename else error}", file=sys.stderr)
        return 2
    except (OSError, ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        command = "same command" + " without --fresh" * options.get("fresh", False)
        kept = f" The {command} continues where it stopped."
        words = kept if call in (_run, _lung) else ""
        print(f"\nInterrupted.{words}", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    is_module = Path(sys.argv[0]).parts[-2:] == ("delucax", "__main__.py")
    prog = "python -m delucax" if is_module else "delucax"
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Differentiable control in JAX.",
        epilog=f"To see the options of a command: {prog} COMMAND --help",
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


_FILE = "a Python file with experiments, a module, or a suite that `list` shows"
_CASES = (
    _expression(
        "-k",
        "select",
        "only cases with a matching name, such as 'lqr and not cartpole'",
    ),
    _expression("-m", "marks", "only cases with matching marks, such as 'not slow'"),
)
_PAGE = _option(
    "--html",
    "also write a web page with tables and figures to this file (default: no page)",
    metavar="PAGE",
)


@_command(
    "train controllers of a pendulum, then reproduce the paper with fewer seeds (about "
    "two minutes)",
    _option("--out", "folder for the results", default="demo", metavar="DIR"),
    _number("--seeds", "number of networks to train", 2),
)
def _demo(out: str, seeds: int) -> None:
    from .studies import demo

    demo(out, seeds=seeds)


@_command(
    "regenerate the figures and tables of the Deluca paper and check its claims",
    _option("name", "one or more of the names below", nargs="+", metavar="NAME"),
    _option("--out", "folder for the results", default="paper", metavar="DIR"),
    _flag("--small", "use fewer seeds and steps"),
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
    "run the ventilator study: learn lungs from breaths, then train controllers",
    _option(
        "--out",
        "folder for the results; a study that was interrupted continues there",
        default="lung",
        metavar="DIR",
    ),
    _flag("--small", "study two lungs with short trainings, in about a minute"),
    _option(
        "--data",
        "CSV file of recorded breaths, in the format of the public data set (default: "
        "simulate breaths)",
        metavar="CSV",
    ),
    _number(
        "--seeds", "number of networks of each kind (default: 3, or 1 with --small)"
    ),
    _number(
        "--sensor-delay",
        "delay of the pressure sensor, in samples; applies to --data too",
        2,
    ),
)
def _lung(out: str, **options: Any) -> None:
    from .studies import lung_study

    lung_study(out, **options)


@_command(
    "show the tasks, controllers, planners, estimators, studies and suites, or the "
    "cases of FILE",
    _option(
        "file",
        f"show the cases of {_FILE} (default: show all names)",
        nargs="?",
        metavar="FILE",
    ),
    *_CASES,
)
def _list(file: str | None, select: str, marks: str) -> int | None:
    if file is None:
        return _list_names()
    from .experiments.commands import list_cases

    list_cases(file, _SUITES, select, marks)


def _list_names() -> None:
    """Print the names of what can be run."""
    from . import controllers, environments, estimators, lung, planning
    from ._controller import AbstractController as controller
    from .studies.paper import STUDIES

    planner, estimator = planning.AbstractPlanner, estimators.AbstractEstimator
    tasks = [name for name in environments.registered() if "/" not in name]
    columns = {
        'Tasks, for delucax.make("NAME")': tasks,
        "Controllers, in delucax.controllers": _made_in(controllers, controller),
        "Controllers of ventilators, in delucax.lung": _made_in(lung, controller),
        "Planners, in delucax.planning": _made_in(planning, planner, planning.Plan),
        "Estimators, in delucax.estimators": _made_in(estimators, estimator),
        "Studies of the paper, for python -m delucax reproduce NAME": [*STUDIES],
        "Suites, for python -m delucax run NAME": [*_SUITES],
    }
    for number, (title, names) in enumerate(columns.items()):
        print(f"\n{title}:" if number else f"{title}:")
        width = max(map(len, names)) + 2
        rows = -(-len(names) // max(1, 78 // width))
        for k in range(rows):
            row = "".join(name.ljust(width) for name in names[k::rows])
            print(f"  {row}".rstrip())


def _made_in(package: ModuleType, *kinds: type) -> list[str]:
    """The classes of some kinds in a package, and the functions that make them."""

    def makes(member: Any) -> bool:
        if inspect.isfunction(member):
            made = inspect.signature(member).return_annotation
            return inspect.isclass(made) and issubclass(made, kinds)
        is_kind = inspect.isclass(member) and issubclass(member, kinds)
        return is_kind and member not in kinds and not inspect.isabstract(member)

    members = {name: getattr(package, name) for name in dir(package) if name[0] != "_"}
    return sorted((n for n, member in members.items() if makes(member)), key=str.lower)


@_command(
    "run the experiments of FILE",
    _option("file", _FILE, metavar="FILE"),
    *_CASES,
    _flag("--slow", "also run the cases marked slow"),
    _number("--seeds", "number of seeds (default: the number that FILE gives)"),
    _number("--workers", "number of processes; -1 starts one for each core", 1),
    _option(
        "--dask",
        "address of the scheduler of a Dask cluster to run on, such as "
        "tcp://scheduler:8786 (default: this machine)",
        metavar="ADDRESS",
    ),
    _option("--store", "results file to write (default: results/FILE.jsonl)"),
    _PAGE,
    _flag("--fresh", "run all cases, also those with stored results"),
    _flag("--retry", "run the cases again that failed before"),
    _flag("--quiet", "show no progress bar", dest="progress", action="store_false"),
    more="""
        examples:
          python -m delucax run sweep.py --workers 2
          python -m delucax run sweep.py -k "lqr and not cartpole" --seeds 32
          python -m delucax run scoreboard --html scoreboard.html

        Each result is stored as soon as it is there. The same command continues an
        interrupted run, and runs only the cases that are new or have changed.
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
    "show the results that `run` stored, or compare two results files",
    _option(
        "results",
        "a results file, such as results/sweep.jsonl; two files with --diff",
        nargs="+",
        metavar="RESULTS",
    ),
    _flag("--diff", "compare two results files, with paired 95%% intervals"),
    _PAGE,
    _option(
        "--export",
        "write all rows to a .csv, .parquet, .md or .tex file; may be given several "
        "times (default: no file)",
        **{"action": "append", "metavar": "TABLE"},
    ),
    _expression("-k", "select", "only cases with a matching name"),
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
    "measure speed against other libraries (in a checkout of the repository)",
    _option(
        "name",
        "one benchmark, such as pendulum (default: pendulum, wall_clock and "
        "environments)",
        nargs="?",
        metavar="NAME",
    ),
)
def _bench(name: str | None) -> int:
    sys.path.insert(0, str(Path.cwd()))
    if importlib.util.find_spec("benchmarks") is None:
        raise ValueError(
            "bench: there is no folder `benchmarks` here. Run this command in a "
            "checkout of the repository."
        )
    modules = pkgutil.iter_modules(importlib.import_module("benchmarks").__path__)
    names = [each.name for each in modules if not each.name.startswith("_")]
    if name not in (None, *names):
        words = f"NAME must be one of {', '.join(names)}, got {name!r}"
        raise ValueError(f"bench: {words}.")
    module = "benchmarks" if name is None else f"benchmarks.{name}"
    return subprocess.run([sys.executable, "-u", "-m", module]).returncode


if __name__ == "__main__":
    sys.exit(main())
