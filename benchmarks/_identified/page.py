"""The page with ours beside what is published."""

import json
from pathlib import Path
from typing import Any

from benchmarks._identified.published import RESULTS as PUBLISHED, SOURCES


PAGE = Path(__file__).parents[2] / "docs" / "identification_exam.md"
_HEAD = """# Identification, graded by public data

Three public problems of nonlinear identification with published results beside ours,
and two checks on simulated and rebuilt plants. `python -m benchmarks.identification
--data DIR` makes this page.

Each model is fitted to the estimation half alone, in double precision. It then runs
freely along the test, by the recorded input, from a state that is estimated on the
first 50 samples. The error is the root of the mean square after these. Networks have
ten seeds, and their median, least and largest errors are shown; how much a network may
do is chosen on the last quarter of the estimation half. Published numbers are as their
sources print them. They may be of other splits where they are older than the package
`nonlinear_benchmarks`, which defines those used here.
"""
_TITLES = {
    "tanks": (
        "Cascaded tanks",
        "Two tanks of which the lower one is measured, and which overflow. 1,024 "
        "samples for estimation and for the test, every 4 s. The data are those of "
        "nonlinearbenchmark.org, as a file `cascaded_tanks/dataBenchmark.csv` with the "
        "columns `uEst`, `yEst`, `uVal` and `yVal`. The physics: Bernoulli's law, the "
        "overflow, an offset of the pump and the depth of the outlet. The error is in "
        "V.",
    ),
    "silverbox": (
        "Silverbox",
        "An electronic oscillator with a cubic spring. The data are those of "
        "nonlinearbenchmark.org, as a file `silverbox/SNLS80mV.csv.gz` with the "
        "columns `V1` and `V2`. The tests: the last quarter of the multisine, the "
        "arrow, and the part of the arrow that stays within the amplitudes of the "
        "estimation. The error is in mV. Ours are fitted to the first 16,000 of the "
        "65,062 samples.",
    ),
    "bouc_wen": (
        "Bouc-Wen",
        "An oscillator with a hysteretic force. The data are generated from the "
        "published equations, constants and signals, with random phases and an "
        "integrator of our own, so that the test records are not the official ones. "
        "The physics knows the oscillator, and that a force is hidden; a network "
        "learns its rate. The error is in micrometres; the noise of the estimation "
        "data is 8. Ours are fitted to the first 8,192 of the 40,960 samples.",
    ),
}


def page(results: Path) -> None:
    """Write the page from the results."""
    found = json.loads(results.read_text()) if results.exists() else {}
    parts = [_HEAD]
    for name, (title, about) in _TITLES.items():
        if name in found:
            parts.append(f"## {title}\n\n{about}\n\n{_table(name, found[name])}")
    if "coverage" in found:
        parts.append(_coverage(found["coverage"]["rows"]))
    parts.append(
        "## Sources\n\n" + "\n".join(f"- {k}: {v}" for k, v in SOURCES.items())
    )
    PAGE.write_text("\n\n".join(part.strip() for part in parts) + "\n")


def _table(name: str, result: dict[str, Any]) -> str:
    tests = list(result["rows"][0])[2:]
    lines = [
        "| method | " + " | ".join(tests) + " | source |",
        "|---|" + "---|" * (len(tests) + 1),
    ]
    for row in result["rows"]:
        several = row["seeds"] > 1 and row[tests[0]]["least"] < row[tests[0]]["most"]
        entries = [_entry(row[test], several) for test in tests]
        seeds = f", median of {row['seeds']} seeds" if several else ""
        label = f"**{row['method']}**{seeds}"
        lines.append(f"| {label} | " + " | ".join(entries) + " | delucax |")
    for method, errors, source in PUBLISHED[name]:
        entries = [f"{errors[test]:g}" if test in errors else "-" for test in tests]
        lines.append(f"| {method} | " + " | ".join(entries) + f" | {source} |")
    seconds = result["longest fit, s"]
    lines.append(f"\nThe longest fit took {seconds:.0f} s with compilation.")
    return "\n".join(lines)


def _entry(values: dict[str, float], several: bool) -> str:
    text = f"{values['median']:.3g}"
    ends = f" ({values['least']:.3g} to {values['most']:.3g})"
    return text + (ends if several else "")


def _coverage(rows: list[dict[str, Any]]) -> str:
    lines = [
        "## Intervals",
        "",
        f"How often intervals of 95% hold the truth, on {rows[0]['records']:,} "
        "simulated records of each of three plants with a hidden state. The guess of "
        "each parameter is 20% off. A fit that says it did not converge, or that the "
        "data do not tell a parameter, is a failure and has no intervals.",
        "",
        "| plant | covered, % | by parameter, % | failures, % |",
        "|---|---|---|---|",
    ]
    for row in rows:
        each = ", ".join(f"{share:.1f}" for share in row["each, %"])
        covered, failed = row["covered, %"], row["failures, %"]
        lines.append(f"| {row['plant']} | {covered:.1f} | {each} | {failed:.1f} |")
    return "\n".join(lines)
