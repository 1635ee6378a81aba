"""`python -m delucax`: the commands."""

import argparse
import sys
import textwrap
from typing import Any


def main(arguments: list[str] | None = None) -> int:
    """The command line; the exit status is 1 if cases failed, 2 on wrong arguments."""
    options = _parser().parse_args(arguments)
    try:
        return options.call(options) or 0
    except (OSError, ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m delucax",
        description="Differentiable control in JAX.",
        epilog="python -m delucax COMMAND --help tells more of each.",
    )
    commands = parser.add_subparsers(
        title="commands", dest="command", metavar="COMMAND", required=True
    )
    _add_demo(commands)
    _add_reproduce(commands)
    _add_lung(commands)
    _add_list(commands)
    _add_run(commands)
    _add_report(commands)
    _add_bench(commands)
    return parser


def _command(commands: Any, name: str, call: Any, help: str, more: str = "") -> Any:
    """A command: `call` is given its options, and returns the exit status."""
    added = commands.add_parser(
        name,
        help=help,
        description=f"{help[0].upper()}{help[1:]}.",
        epilog=textwrap.dedent(more).strip() or None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.set_defaults(call=call)
    return added


def _add_demo(commands: Any) -> None:
    def call(options: Any) -> None:
        from .experiments import demo

        demo(options.out, seeds=options.seeds)

    help = "swing the pendulum up, then the paper in small; in about two minutes"
    demo = _command(commands, "demo", call, help)
    demo.add_argument("--out", default="demo", help="folder to write to")
    demo.add_argument("--seeds", type=int, default=2, help="how many MLPs to train")


def _add_reproduce(commands: Any) -> None:
    def call(options: Any) -> int:
        from .experiments import reproduce

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
        from .lung import lung_study

        names = ("small", "data", "seeds", "sensor_delay")
        lung_study(options.out, **{name: getattr(options, name) for name in names})

    help = "learn lungs from breaths, and controllers of a ventilator in them"
    lung = _command(commands, "lung", call, help)
    lung.add_argument("--out", default="lung", help="folder to write to, or go on in")
    lung.add_argument("--small", action="store_true", help="two lungs, in a minute")
    lung.add_argument("--data", help="breaths, as a CSV file of the public data set")
    lung.add_argument("--seeds", type=int, help="controllers of each kind, 3 if not")
    late = "samples that the sensor is late, in DATA too; 2 if not"
    lung.add_argument("--sensor-delay", type=int, default=2, help=late)


def _add_list(commands: Any) -> None:
    def call(options: Any) -> int:
        from .experiments._cli import list_command

        return list_command(options.file, options.select, options.marks)

    help = "name the tasks, controllers and suites, or the cases of FILE"
    listed = _command(commands, "list", call, help)
    listed.add_argument("file", nargs="?", metavar="FILE", help="as for run")
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
    run.add_argument(
        "file", metavar="FILE", help="a Python file, a module, or a suite from list"
    )
    _add_selection(run)
    run.add_argument("--slow", action="store_true", help="also cases marked slow")
    run.add_argument("--seeds", type=int, help="this many instead of the file's own")
    run.add_argument(
        "--workers", type=int, default=1, help="processes; -1 is one for each core"
    )
    run.add_argument(
        "--dask", metavar="ADDRESS", help="run on the Dask cluster of this scheduler"
    )
    run.add_argument("--store", help="results file; results/FILE.jsonl by default")
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
        "-k", dest="select", default="", metavar="EXPR", help="only these cases"
    )


def _add_bench(commands: Any) -> None:
    def call(options: Any) -> int:
        from .experiments._cli import bench_command

        return bench_command(options.name)

    help = "measure speed against other libraries, in a checkout"
    bench = _command(commands, "bench", call, help)
    bench.add_argument("name", nargs="?", help="one benchmark, such as pendulum")


def _add_selection(command: Any) -> None:
    command.add_argument(
        "-k",
        dest="select",
        default="",
        metavar="EXPR",
        help="cases by name, such as 'lqr and not cartpole'",
    )
    command.add_argument(
        "-m", dest="marks", default="", metavar="EXPR", help="cases by their marks"
    )


if __name__ == "__main__":
    sys.exit(main())
