"""`python -m benchmarks.riccati_exam`: published Riccati equations, system by system.

The relative residual of SciPy, of slycot if it is installed, and of delucax; what
delucax certifies, and its result. Prints a table, and writes
`benchmarks/results/riccati_exam.json` and `docs/riccati_exam.md`.
"""

import os


for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import importlib.util  # noqa: E402
import json  # noqa: E402
import sys  # noqa: E402
import warnings  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import jax  # noqa: E402
import numpy as np  # noqa: E402
import scipy.linalg  # noqa: E402

import delucax as dlx  # noqa: E402
from benchmarks._machine import describe, keep_programs, limit_cores  # noqa: E402


ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import riccati_systems  # noqa: E402  # pyright: ignore[reportMissingImports]


OUT = Path(__file__).parent / "results" / "riccati_exam.json"
PAGE = ROOT / "docs" / "riccati_exam.md"
HEAD = """# Riccati equations, system by system

Does a solver find the right solution of your Riccati equation? This page compares SciPy
and delucax on published test systems. `python -m benchmarks.riccati_exam` makes it.

There are 39 systems: the 20 continuous and 15 discrete systems of the collections CAREX
and DAREX (Benner, Laub and Mehrmann, 1995), and four systems that users of SciPy
reported. The data of the collections are those of SciPy's own tests. In the second
table, some of these systems have other values of their parameters.

How to read the first table:

- **SciPy**, **slycot**, **delucax**: the relative residual of the solution that each
  solver finds in double precision. The relative residual is the residual of the
  equation, divided by the sum of the norms of the terms of the equation. This residual
  is evaluated with 60 digits for all solvers.
- **reported**: the residual that delucax itself returns. The returned residual should
  never be smaller than the residual in the column "delucax".
- **bound**: the spectral abscissa of the closed loop in continuous time (below 0 if the
  loop is stable), and its spectral radius in discrete time (below 1). This column is
  important because a small residual does not prove that a solution stabilises the
  plant.
- **result**: the status of the solution that delucax returns.
- **float32**, **its result**: the residual and the status of delucax in single
  precision. The data are rounded to single precision first. An equation counts as
  solved if the residual is at most 1e-5, instead of 1e-12. If single precision is not
  enough for an equation, the status of the solution shows this.

The closed loop of the system CAREX 11 is on the boundary of stability.

"""

COLUMNS = "SciPy", "slycot", "delucax", "reported"
RESULTS = {
    "successful": "stabilising",
    "on_boundary": "on the boundary",
    "not_stabilisable": "not stabilisable",
    "not_stabilising": "not stabilising",
    "not_converged": "not converged",
    "ill_posed": "ill-posed",
}


def slycot_solver(continuous: bool) -> Callable | None:
    """slycot's solver behind python-control, if it is there."""
    if importlib.util.find_spec("slycot") is None:
        return None
    import control

    solver = control.care if continuous else control.dare
    return lambda A, B, Q, R: solver(A, B, Q, R, method="slycot")[0]


def residual_of(solver: Callable | None, continuous: bool, *data) -> float | None:
    """The relative residual of a solver; NaN if it raises, `None` if there is none."""
    if solver is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            X = solver(*data)
            return riccati_systems.true_residual(not continuous, *data, X)
        except (np.linalg.LinAlgError, ValueError, RuntimeError):
            return float("nan")


def outcome(result: Any) -> str:
    """A result in a word or two."""
    return next(t for n, t in RESULTS.items() if result == getattr(dlx.RESULTS, n))


def in_single(solver: Callable, measure: Callable, *data) -> dict[str, Any]:
    """What the solver makes of the data in float32."""
    if any(map(np.iscomplexobj, data)):
        return {"float32": None, "float32 result": "-"}
    rounded = [np.asarray(M, np.float32) for M in data]
    try:
        solution = solver(*rounded, throw=False)
    except ValueError:  # rounding has made a weight singular
        return {"float32": None, "float32 result": "refused"}
    X = np.asarray(solution.X, np.float64)
    exact = [np.asarray(M, np.float64) for M in rounded]
    return {
        "float32": float(measure(*exact, X)[0]),
        "float32 result": outcome(solution.result),
    }


def examine(name: str, continuous: bool, *data: np.ndarray) -> dict[str, Any]:
    """One row of the table."""
    print(f"{name}, {len(data[0])} states", file=sys.stderr, flush=True)
    if continuous:
        ours, theirs = dlx.riccati.care, scipy.linalg.solve_continuous_are
        measure = riccati_systems.continuous_residual
    else:
        ours, theirs = dlx.riccati.dare, scipy.linalg.solve_discrete_are
        measure = riccati_systems.discrete_residual
    solution = ours(*data, throw=False)
    bound = solution.spectral_abscissa if continuous else solution.spectral_radius
    real = not any(map(np.iscomplexobj, data))
    slycot = slycot_solver(continuous) if real else None
    return {
        "system": name,
        "n": len(data[0]),
        "SciPy": residual_of(theirs, continuous, *data),
        "slycot": residual_of(slycot, continuous, *data),
        "delucax": riccati_systems.true_residual(not continuous, *data, solution.X),
        "reported": float(solution.residual),
        "bound": float(np.asarray(bound)),
        "result": outcome(solution.result),
        **in_single(ours, measure, *data),
    }


def number(value: float | None) -> str:
    """A residual in one digit; a dash if there is none."""
    if value is None:
        return "-"
    return "raises" if np.isnan(value) else f"{value:.0e}"


def page(rows: list[dict[str, Any]], families: list[dict[str, Any]]) -> str:
    """The table in Markdown."""
    head = "| system | n | SciPy | slycot | delucax | reported | bound | result |"
    lines = [HEAD + head + " float32 | its result |", "|---" * 10 + "|"]
    for row in rows:
        residuals = (number(row[name]) for name in COLUMNS)
        cells = (row["system"], row["n"], *residuals, f"{row['bound']:.8g}")
        single = number(row["float32"]), row["float32 result"]
        lines.append(
            "| " + " | ".join(map(str, (*cells, row["result"], *single))) + " |"
        )
    if all(row["slycot"] is None for row in rows):
        lines.append(
            "\nslycot was not installed on the machine on which this page was made."
        )
    lines.append("\n## Families\n")
    lines.append(
        "The members of a family are one system with different values of its "
        "parameters. The columns SciPy and delucax show how many members of the "
        "family the solver solves. A member counts as solved if the residual is at "
        "most 1e-12. For delucax, the solution must also be certified as "
        "stabilising. The next two columns show the largest residual of each solver. "
        "The last two columns are for delucax in float32: the number of members that "
        "are certified, and the largest residual of the certified members.\n"
    )
    head = "| family | members | SciPy | delucax | worst SciPy | worst delucax |"
    lines += [head + " float32 | its worst |", "|---" * 8 + "|"]
    for row in families:
        cells = (row["family"], row["members"], row["SciPy good"], row["delucax good"])
        worst = number(row["worst SciPy"]), number(row["worst delucax"])
        single = row["float32 certified"], number(row["worst float32"])
        cells = *cells, *worst, *single
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def certified(rows: list[dict[str, Any]]) -> list[float]:
    """The residuals of what is certified in single precision."""
    return [row["float32"] for row in rows if row["float32 result"] == "stabilising"]


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The families in a line each."""
    families: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        families.setdefault(row["system"].split(",")[0], []).append(row)
    return [
        {
            "family": name,
            "members": len(members),
            "SciPy good": sum(row["SciPy"] <= 1e-12 for row in members),
            "delucax good": sum(
                row["delucax"] <= 1e-12 and row["result"] == "stabilising"
                for row in members
            ),
            "float32 certified": len(certified(members)),
            "worst float32": max(certified(members), default=None),
            "worst SciPy": float(np.max([row["SciPy"] for row in members])),
            "worst delucax": max(row["delucax"] for row in members),
        }
        for name, members in families.items()
    ]


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.riccati_exam")
    parser.add_argument("--out", default=str(OUT))
    parser.add_argument("--page", default=str(PAGE))
    parser.add_argument("--cores", type=int, default=1)
    options = parser.parse_args()
    limit_cores(options.cores)
    keep_programs()
    jax.config.update("jax_enable_x64", True)

    rows = [examine(name, True, *data) for name, *data in riccati_systems.carex()]
    rows += [examine(name, False, *data) for name, *data in riccati_systems.darex()]
    swept = [
        examine(name, True, *data) for name, *data in riccati_systems.carex_families()
    ]
    swept += [
        examine(name, False, *data)
        for name, *data in riccati_systems.darex_families((2, 10, 50))
    ]
    families = summary(swept)
    text = page(rows, families)
    print(text)
    content = {
        "machine": describe(),
        "scipy": scipy.__version__,
        "systems": rows,
        "families": families,
        "members": swept,
    }
    out = Path(options.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(content, indent=1) + "\n")
    Path(options.page).write_text(text)
    print(f"written: {out} and {options.page}")


if __name__ == "__main__":
    main()
