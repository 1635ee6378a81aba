"""What the commands `list`, `run`, `report` and `bench` do."""

import importlib
import importlib.util
import inspect
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from .. import controllers
from ..environments import registered
from ._experiment import Experiment
from ._report import diff, DIFF_COLUMNS, diff_page, summary
from ._results import _text, Results
from ._run import run


# Experiments that come with the library, by the name of their module here.
SUITES = ("scoreboard",)


def list_command(file: str | None, select: str, marks: str) -> int:
    """Names of tasks, controllers and suites; or the cases of a file."""
    if file is not None:
        count = 0
        for made in load(file):
            for case in made.cases(select, marks, slow=True):
                labels = [mark.name for mark in case.marks]
                count += 1
                print(case.id + (f"  ({', '.join(labels)})" if labels else ""))
        print(f"{count} cases")
        return 0
    short = [name for name in registered() if "/" not in name]
    print('Tasks, for delucax.make("..."):')
    _print_columns(short)
    print("\nControllers, in delucax.controllers:")
    names = [name for name, member in vars(controllers).items() if _acts(name, member)]
    _print_columns(sorted(names, key=str.lower))
    print("\nSuites, for python -m delucax run ...:")
    _print_columns(list(SUITES))
    return 0


def run_command(
    file: str, store: str | None, html: str | None, options: dict[str, Any]
) -> int:
    """Run the experiments of a file and show what came out."""
    found = load(file)
    place = Path("results") / f"{Path(file).stem}.jsonl" if store is None else store
    results = run(*found, store=place, **options)
    done = {row["case"] for row in results.rows if row["status"] != "skipped"}
    if not done:
        raise ValueError(
            f"run: no case of '{file}' is selected (-k, -m, or marked skip or slow)."
        )
    show(results)
    bad = {row["case"]: row for row in results.failed}
    for case, row in bad.items():
        first = str(row["error"] or "passed though it was expected to fail")
        print(f"FAILED {case}: {first.splitlines()[0]}", file=sys.stderr)
    print(f"{len(done)} cases in {place}")
    if html is not None:
        results.report(html, title=Path(file).stem)
        print(f"report in {html}")
    return 1 if bad else 0


def report_command(
    paths: list[str],
    compare: bool,
    html: str | None,
    exports: list[str],
    select: str,
) -> int:
    """Show one results file, or what differs between two."""
    if compare:
        if len(paths) != 2:
            raise ValueError(
                f"report: --diff needs two results files, got {len(paths)}."
            )
        if exports:
            raise ValueError("report: --export goes with one results file, not --diff.")
        found = diff(*(_read(path, select) for path in paths))
        if found["changed"]:
            print(_text("markdown", DIFF_COLUMNS, found["changed"], 4))
        for line in found["status"]:
            print(f"{line[1]}: {line[2]} in {paths[0]}, {line[3]} in {paths[1]}")
        for name, key in zip(paths, ("only_first", "only_second"), strict=True):
            for _, case in found[key]:
                print(f"{case}: only in {name}")
        cases = len({tuple(line[:2]) for line in found["changed"]})
        print(f"{found['same']} cases are the same, {cases} differ")
        if html is not None:
            names = (paths[0], paths[1])
            Path(html).write_text(diff_page(found, names), encoding="utf-8")
            print(f"report in {html}")
        return 0
    if len(paths) != 1:
        raise ValueError("report: two results files are compared with --diff.")
    results = _read(paths[0], select)
    show(results)
    for path in exports:
        results.export(path)
        print(f"written {path}")
    if html is not None:
        results.report(html, title=Path(paths[0]).stem)
        print(f"report in {html}")
    return 0


def bench_command(name: str | None) -> int:
    """Run the benchmarks of a checkout, each as a module of its own."""
    sys.path.insert(0, str(Path.cwd()))
    if importlib.util.find_spec("benchmarks") is None:
        raise ValueError(
            "bench: the benchmarks are in the repository and not in the package: run "
            "this in a checkout of it."
        )
    module = "benchmarks" if name is None else f"benchmarks.{name}"
    if importlib.util.find_spec(module) is None:
        raise ValueError(f"bench: there is no benchmark called {name!r}.")
    return subprocess.run([sys.executable, "-u", "-m", module]).returncode


def _acts(name: str, member: Any) -> bool:
    """Whether it is a controller, or a function that makes one."""
    if inspect.isclass(member):
        return hasattr(member, "applied") and not inspect.isabstract(member)
    if not inspect.isfunction(member):
        return False
    made = inspect.signature(member).return_annotation
    is_controller = inspect.isclass(made) and hasattr(made, "applied")
    return is_controller or name != name.lower()


def show(results: Results) -> None:
    """A table of means for each experiment."""
    for name in dict.fromkeys(row["experiment"] for row in results.rows):
        columns, body = summary(results.where(experiment=name))
        print(f"\n{name}\n\n{_text('markdown', columns, body, 4)}")


def load(file: str) -> list[Experiment]:
    """The experiments of a file, of a module by its dotted name, or of a suite."""
    if file in SUITES:
        module = importlib.import_module(f"{__package__}._{file}")
    elif file.endswith(".py"):
        module = _module_at(Path(file))
    else:
        sys.path.insert(0, str(Path.cwd()))
        try:
            module = importlib.import_module(file)
        except ImportError as error:
            raise ValueError(
                f"run: FILE must be a Python file, a module or one of "
                f"{', '.join(SUITES)}; {file!r} cannot be imported: {error}."
            ) from error
    own = [v for v in vars(module).values() if isinstance(v, Experiment)]
    found = list({id(made): made for made in own}.values())
    if not found:
        raise ValueError(f"run: there is no experiment in {file}.")
    return found


def _module_at(path: Path) -> ModuleType:
    if not path.is_file():
        raise ValueError(f"run: there is no file '{path}'.")
    path = path.resolve()
    name = path.stem if path.stem not in sys.modules else f"_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent))
    spec.loader.exec_module(module)
    try:
        import cloudpickle
    except ImportError:
        return module
    # Workers do not find it by its name.
    cloudpickle.register_pickle_by_value(module)
    return module


def _read(path: str, select: str) -> Results:
    from ._select import selector

    results = Results.read(path)
    chosen = selector(select, "select", "report")
    rows = [
        row
        for row in results.rows
        if chosen(lambda word, row=row: word.lower() in row["case"].lower())
    ]
    return Results(rows, results.metrics, results.parameters)


def _print_columns(names: list[str]) -> None:
    width = max(map(len, names)) + 2
    count = max(1, 78 // width)
    rows = -(-len(names) // count)
    for k in range(rows):
        print("  " + "".join(name.ljust(width) for name in names[k::rows]).rstrip())
