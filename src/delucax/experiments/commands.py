"""The commands `list`, `run` and `report`."""

import dataclasses
import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from .._page import as_text, Page
from ._cases import selector
from ._experiment import Experiment
from ._report import by_experiment, diff, DIFFERENCES, page_of, summary
from ._results import Results
from ._run import run


def list_cases(file: str, suites: Mapping[str, str], select: str, marks: str) -> None:
    """Show the cases of a file."""
    experiments = load(file, suites, "list")
    cases = [case for one in experiments for case in one.cases(select, marks, True)]
    for case in cases:
        labels = ", ".join(mark.name for mark in case.marks)
        print(f"{case.id}  ({labels})" if labels else case.id)
    print(f"{len(cases)} cases")


def run_file(
    file: str,
    suites: Mapping[str, str],
    store: str | None,
    html: str | None,
    options: dict[str, Any],
) -> int:
    """Run the experiments of a file and print their results."""
    experiments = load(file, suites, "run")
    # Not the stem, because a module may have dots in its name.
    name = Path(file).name.removesuffix(".py")
    place = Path("results") / f"{name}.jsonl" if store is None else store
    results = run(*experiments, store=place, **options)
    done = {row["case"] for row in results.rows if row["status"] != "skipped"}
    if not done:
        raise ValueError(
            f"run: no case of '{file}' is selected. Check -k and -m. Cases marked slow "
            "need --slow, and cases marked skip never run."
        )
    _show(results)
    failed = {row["case"]: row for row in results.failed}
    for case, row in failed.items():
        first = str(row["error"] or "it passed, but was expected to fail")
        print(f"FAILED {case}: {first.splitlines()[0]}", file=sys.stderr)
    print(f"The results of {len(done)} cases are in {place}")
    _write_page(html, lambda: page_of(results, name))
    return bool(failed)


def report_file(
    paths: list[str], select: str, html: str | None, exports: list[str]
) -> None:
    """Show one results file."""
    if len(paths) != 1:
        raise ValueError(
            f"report: expected one results file, got {len(paths)}. To compare two "
            "files, add --diff."
        )
    results = _read(paths[0], select)
    _show(results)
    for path in exports:
        results.export(path)
        print(f"Wrote {path}")
    _write_page(html, lambda: page_of(results, Path(paths[0]).stem))


def report_diff(
    paths: list[str], select: str, html: str | None, exports: list[str]
) -> None:
    """Show what differs between two results files."""
    if len(paths) != 2:
        raise ValueError(f"report: --diff needs two results files, got {len(paths)}.")
    if exports:
        raise ValueError("report: --export and --diff cannot be combined.")
    difference = diff(*(_read(path, select) for path in paths))
    if difference.changed:
        print(as_text("markdown", DIFFERENCES, difference.changed))
    for _, case, *states in difference.status:
        print(f"{case}: {states[0]} in {paths[0]}, {states[1]} in {paths[1]}")
    for name, cases in zip(paths, difference.only, strict=True):
        for _, case in cases:
            print(f"{case}: only in {name}")
    differ = {tuple(line[:2]) for line in difference.changed}
    print(f"{difference.same} cases are the same, {len(differ)} differ")
    _write_page(html, lambda: difference.page((paths[0], paths[1])))


def _show(results: Results) -> None:
    """Print a table of means for each experiment."""
    for name, part in by_experiment(results).items():
        print(f"\n{name}\n\n{as_text('markdown', *summary(part))}")


def _write_page(path: str | None, make: Callable[[], Page]) -> None:
    if path is not None:
        make().write(path)
        print(f"Wrote {path}")


def load(file: str, suites: Mapping[str, str], command: str) -> list[Experiment]:
    """Load the experiments of a Python file, of a module by its dotted name, or of a
    suite, which is a short name for a module. Errors name the command."""
    if file in suites:
        module = importlib.import_module(suites[file])
    elif file.endswith(".py"):
        module = _module_at(Path(file), command)
    else:
        sys.path.insert(0, str(Path.cwd()))
        try:
            module = importlib.import_module(file)
        except ImportError as error:
            raise ValueError(
                f"{command}: FILE must be a Python file, a module or a suite "
                f"({', '.join(suites)}). {file!r} cannot be imported: {error}."
            ) from error
    own = [v for v in vars(module).values() if isinstance(v, Experiment)]
    if not own:
        raise ValueError(f"{command}: there is no experiment in {file}.")
    return list({id(made): made for made in own}.values())


def _module_at(path: Path, command: str) -> ModuleType:
    if not path.is_file():
        raise ValueError(f"{command}: there is no file '{path}'.")
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
    # Workers cannot import it by its name.
    cloudpickle.register_pickle_by_value(module)
    return module


def _read(path: str, select: str) -> Results:
    results = Results.read(path)
    is_selected = selector(select, "select", "report")
    contains = lambda row: lambda word: word.lower() in row["case"].lower()
    rows = [row for row in results.rows if is_selected(contains(row))]
    return dataclasses.replace(results, rows=rows)
