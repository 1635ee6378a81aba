"""`python -m delucax`: the commands."""

import argparse
import sys
import textwrap
from importlib.metadata import version
from pathlib import Path
from typing import Any


_FILE = "a Python file of experiments, a module, or a suite that `list` names"


def main(arguments: list[str] | None = None) -> int:
    """The command line; the exit status is 1 if cases failed, 2 on wrong arguments."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        if options.version:
            print(f"delucax {version('delucax')}")
            return 0
        if options.command is None:
            parser.print_help()
            return 0
        return options.call(options) or 0
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
    parser.add_argument("--version", action="store_true", help="show the version")
    commands = parser.add_subparsers(
        title="commands", dest="command", metavar="COMMAND"
    )
    _add_demo(commands)
    _add_reproduce(commands)
    _add_lung(commands)
    _add_list(commands)
    _add_run(commands)
    _add_report(commands)
    _add_bench(commands)
    return parser


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the line breaks of examples, and adds the default to an option's help."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        shown = isinstance(action.default, str | int) and action.default not in ("", 0)
        if not shown or action.default == argparse.SUPPRESS:
            return action.help
        return f"{action.help} (default: %(default)s)"


def _command(commands: Any, name: str, call: Any, help: str, more: str = "") -> Any:
    """A command: `call` is given its options, and returns the exit status."""
    added = commands.add_parser(
        name,
        help=help,
        description=f"{help[0].upper()}{help[1:]}.",
        epilog=textwrap.dedent(more).strip() or None,
        formatter_class=_Formatter,
    )
    added.set_defaults(call=call)
    return added


def _add_demo(commands: Any) -> None:
    def call(options: Any) -> None:
        from .studies import demo

        demo(options.out, seeds=options.seeds)

    help = "swing the pendulum up, then the paper in small; in about two minutes"
    demo = _command(commands, "demo", call, help)
    demo.add_argument("--out", default="demo", help="folder to write to")
    demo.add_argument("--seeds", type=int, default=2, help="how many MLPs to train")


def _add_reproduce(commands: Any) -> None:
    def call(options: Any) -> int:
        from .studies import reproduce

        rows = reproduce(options.name, options.out, small=options.small)
        return 0 if all(row["holds"] for row in rows) else 1

    help = "regenerate the figures and tables of the Deluca paper, claim by claim"
    more = """
        names: all, oracle-complexity, policy-gradient, estimator-variance,
          wall-clock, ventilator, pendulum-shock, lq-perturbations

        The exit status is 1 if a claim does not hold.
        """
    paper = _command(commands, "reproduce", call, help, more)
    paper.add_argument("name", nargs="+", metavar="NAME", help="all, or some of these")
    paper.add_argument("--out", default="paper", help="folder to write to")
    paper.add_argument("--small", action="store_true", help="fewer seeds and steps")


def _add_lung(commands: Any) -> None:
    def call(options: Any) -> None:
        from .studies import lung_study

        names = ("small", "data", "seeds", "sensor_delay")
        lung_study(options.out, **{name: getattr(options, name) for name in names})

    help = "learn lungs from breaths, and controllers of a ventilator in them"
    lung = _command(commands, "lung", call, help)
    lung.add_argument("--out", default="lung", help="folder to write to, or go on in")
    lung.add_argument("--small", action="store_true", help="two lungs, in a minute")
    lung.add_argument(
        "--data",
        help="breaths, as a CSV file of the public data set (default: simulated)",
    )
    seeds = "how many controllers of each kind to train (default: 3, or 1 if --small)"
    lung.add_argument("--seeds", type=int, help=seeds)
    late = "how late the sensor reads, in samples; holds for DATA too"
    lung.add_argument("--sensor-delay", type=int, default=2, help=late)


def _add_list(commands: Any) -> None:
    def call(options: Any) -> int:
        from .experiments._cli import list_command

        return list_command(options.file, options.select, options.marks)

    help = "name the tasks, controllers and suites, or the cases of FILE"
    listed = _command(commands, "list", call, help)
    listed.add_argument(
        "file", nargs="?", metavar="FILE", help=f"{_FILE}; its cases are listed"
    )
    _add_selection(listed)


def _add_run(commands: Any) -> None:
    def call(options: Any) -> int:
        from .experiments._cli import run_command

        passed = {
            "select": options.select,
            "marks": options.marks,
            "slow": options.slow,
            "seeds": options.seeds,
            "workers": options.workers,
            "fresh": options.fresh,
            "retry": options.retry,
            "progress": not options.quiet,
        }
        if options.dask is None:
            return run_command(options.file, options.store, options.html, passed)
        from .experiments._dask import client

        with client(options.dask):
            passed["backend"] = "dask"
            return run_command(options.file, options.store, options.html, passed)

    more = """
        examples:
          python -m delucax run sweep.py --workers 2
          python -m delucax run sweep.py -k "lqr and not cartpole" --seeds 32
          python -m delucax run scoreboard --html scoreboard.html

        Results are stored as they arrive; the same command goes on where it was
        stopped, and runs again only what changed.
        """
    help = "run the experiments of FILE"
    run = _command(commands, "run", call, help, more)
    run.add_argument("file", metavar="FILE", help=_FILE)
    _add_selection(run)
    run.add_argument("--slow", action="store_true", help="also cases marked slow")
    run.add_argument("--seeds", type=int, help="how many seeds (default: as FILE says)")
    run.add_argument(
        "--workers", type=int, default=1, help="processes; -1 is one for each core"
    )
    run.add_argument(
        "--dask", metavar="ADDRESS", help="run on the Dask cluster of this scheduler"
    )
    run.add_argument("--store", help="results file (default: results/FILE.jsonl)")
    run.add_argument("--html", metavar="PAGE", help="write a report too")
    run.add_argument("--fresh", action="store_true", help="run also what is stored")
    run.add_argument("--retry", action="store_true", help="run again what failed")
    run.add_argument("--quiet", action="store_true", help="show no progress")


def _add_report(commands: Any) -> None:
    def call(options: Any) -> int:
        from .experiments._cli import report_command

        return report_command(
            options.results, options.diff, options.html, options.export, options.select
        )

    more = """
        examples:
          python -m delucax report results/sweep.jsonl --html sweep.html
          python -m delucax report results/sweep.jsonl --export sweep.tex
          python -m delucax report --diff before.jsonl after.jsonl
        """
    help = "show a results file, or what differs between two"
    report = _command(commands, "report", call, help, more)
    report.add_argument("results", nargs="+", metavar="RESULTS", help="results file")
    report.add_argument(
        "--diff", action="store_true", help="compare two, with paired 95%% intervals"
    )
    report.add_argument(
        "--html", metavar="PAGE", help="write a page of tables, figures"
    )
    report.add_argument(
        "--export",
        action="append",
        default=[],
        metavar="TABLE",
        help="write all rows to a .csv, .parquet, .md or .tex file",
    )
    report.add_argument(
        "-k",
        dest="select",
        default="",
        metavar="EXPR",
        help="only these cases (default: all)",
    )


def _add_bench(commands: Any) -> None:
    def call(options: Any) -> int:
        from .experiments._cli import bench_command

        return bench_command(options.name)

    help = "measure speed against other libraries, in a checkout"
    bench = _command(commands, "bench", call, help)
    bench.add_argument(
        "name", nargs="?", help="one benchmark, such as pendulum (default: all)"
    )


def _add_selection(command: Any) -> None:
    command.add_argument(
        "-k",
        dest="select",
        default="",
        metavar="EXPR",
        help="cases by name, such as 'lqr and not cartpole' (default: all)",
    )
    command.add_argument(
        "-m",
        dest="marks",
        default="",
        metavar="EXPR",
        help="cases by their marks (default: all)",
    )


if __name__ == "__main__":
    sys.exit(main())
