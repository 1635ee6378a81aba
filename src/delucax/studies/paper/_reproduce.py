"""Reproduces the paper with one command."""

import html
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ..._check import check_choice
from ..._extras import extra
from ..._page import Page
from ._finding import Claim, Finding
from ._gradients import estimator_variance, policy_gradient
from ._online_control import lq_perturbations, pendulum_shock
from ._oracle_complexity import oracle_complexity
from ._ventilator import ventilator
from ._wall_clock import wall_clock


STUDIES: dict[str, Callable[..., Finding]] = {
    study.__name__.replace("_", "-"): study
    for study in (
        *(oracle_complexity, policy_gradient, estimator_variance, wall_clock),
        *(ventilator, pendulum_shock, lq_perturbations),
    )
}
"""The studies, in the order of the paper."""


def reproduce(
    names: str | Iterable[str] = "all",
    out: str | Path = "paper",
    *,
    small: bool = False,
    say: Callable[[str], Any] = print,
) -> list[dict[str, Any]]:
    """Regenerate the figures and tables of the Deluca paper, and check its claims.

    The report says whether each claim holds, with the measured number. If a study
    raises an error, the report lists this as a claim that does not hold. The other
    studies still run.

    **Arguments:**

    - `names`: `"all"` (default) or some of `oracle-complexity`, `policy-gradient`,
        `estimator-variance`, `wall-clock`, `ventilator`, `pendulum-shock` and
        `lq-perturbations`.
    - `out`: the folder to write to, `"paper"` by default. The function writes
        `report.html`, `claims.csv` and the figures to it. The folder `lung` (or
        `lung-small`) inside `out` contains the files of
        [`delucax.studies.lung_study`][], which continues from these files if it was
        interrupted.
    - `small`: whether to use fewer seeds and steps; `False` by default.
    - `say`: a function that gets each line of text; `print` by default.

    **Returns:** a dictionary for each claim, with the keys `study`, `claim`, `measured`
    and `holds`.

    **Raises:** `ValueError` if a name in `names` is unknown; `OSError` if the folder
    cannot be written; `ImportError` without pandas or Matplotlib.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021.

    !!! example

        ```python
        import tempfile
        from delucax import studies

        with tempfile.TemporaryDirectory() as folder:
            claims = studies.reproduce("wall-clock", folder, small=True)
        ```
    """
    pd = extra("pandas", "tables")
    extra("matplotlib", "plot")
    chosen = [names] if isinstance(names, str) else list(names)
    for name in chosen:
        check_choice(name, ("all", *STUDIES), "names", "reproduce")
    chosen = list(STUDIES) if "all" in chosen else chosen
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    sections, rows = [], []
    start = time.perf_counter()
    for k, name in enumerate(chosen, 1):
        say(f"[{k}/{len(chosen)}] {name}")
        study_start = time.perf_counter()
        finding = _run(name, out, small, say)
        for claim in finding.claims:
            say(f"  {'holds' if claim.holds else 'DOES NOT HOLD'}: {claim.statement}")
            say(f"    measured: {claim.measured}")
            row = {"study": name, "claim": claim.statement}
            rows.append(row | {"measured": claim.measured, "holds": claim.holds})
        images = []
        for title, figure in finding.figures.items():
            if not isinstance(figure, Path):
                # Draw it only once, because this takes as long as some studies.
                figure.savefig(out / f"{title}.png", dpi=150)
                figure = out / f"{title}.png"
            images.append(figure)
        sections += _section(finding, images)
        pd.DataFrame(rows).to_csv(out / "claims.csv", index=False)
        page = Page("The Deluca paper, reproduced")
        page.paragraph(f"{_held(rows)}.")
        page.parts.extend(sections)
        page.provenance(Path())
        page.write(out / "report.html")
        say(f"  {time.perf_counter() - study_start:.0f} s")
    say(f"{_held(rows)} ({time.perf_counter() - start:.0f} s).")
    say(f"The report is {out / 'report.html'}.")
    return rows


def _held(rows: list[dict[str, Any]]) -> str:
    return f"{sum(row['holds'] for row in rows)} of {len(rows)} claims hold"


def _run(name: str, out: Path, small: bool, say: Callable[[str], Any]) -> Finding:
    """The finding of a study. If the study raises an error, it is a claim that does not
    hold."""
    options = {}
    if name == "ventilator":
        options = {"out": out / ("lung-small" if small else "lung"), "say": say}
    try:
        return STUDIES[name](small, **options)
    except Exception as error:
        (out / f"{name}.txt").write_text(traceback.format_exc())
        failed = Claim("The study runs", f"{type(error).__name__}: {error}", False)
        return Finding(name, [failed], notes=f"The traceback is in {name}.txt.")


def _section(finding: Finding, images: list[Path]) -> list[str]:
    """The parts of a page that show the findings of a study."""
    section = Page(finding.title)
    section.heading(finding.title)
    for claim in finding.claims:
        word = "<b>holds" if claim.holds else "<b class='bad'>does not hold"
        text = f"{claim.statement}. Measured: {claim.measured}."
        section.parts.append(f"<p>{word}</b>: {html.escape(text)}</p>")
    for image in images:
        section.figure(image)
    for title, table in finding.tables.items():
        columns = list(table[0])
        section.heading(title, 3)
        section.table(columns, [[row.get(name) for name in columns] for row in table])
    section.paragraph(finding.notes, "made")
    return section.parts
