"""The paper from one command."""

import base64
import html
import io
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ..._extras import extra
from ...experiments._provenance import device, provenance
from ...experiments._report import _document, _table
from ._estimator_variance import estimator_variance
from ._finding import Claim, Finding
from ._lq_perturbations import lq_perturbations
from ._oracle_complexity import oracle_complexity
from ._pendulum_shock import pendulum_shock
from ._policy_gradient import policy_gradient
from ._ventilator import ventilator
from ._wall_clock import wall_clock


STUDIES: dict[str, Callable[..., Finding]] = {
    "oracle-complexity": oracle_complexity,
    "policy-gradient": policy_gradient,
    "estimator-variance": estimator_variance,
    "wall-clock": wall_clock,
    "ventilator": ventilator,
    "pendulum-shock": pendulum_shock,
    "lq-perturbations": lq_perturbations,
}
"""In the order of the paper."""


def reproduce(
    names: str | Iterable[str] = "all",
    out: str | Path = "paper",
    *,
    small: bool = False,
    say: Callable[[str], Any] = print,
) -> list[dict[str, Any]]:
    """Regenerate figures and tables of the Deluca paper, each claim with its number.

    A claim holds or it does not: the report says which, with what was measured. A study
    that fails is a claim that does not hold, and harms no other.

    **Arguments:**

    - `names`: `"all"` (default) or some of `oracle-complexity`, `policy-gradient`,
        `estimator-variance`, `wall-clock`, `ventilator`, `pendulum-shock` and
        `lq-perturbations`.
    - `out`: the folder to write to, `"paper"` by default: `report.html`, `claims.csv`,
        the figures, and in `lung` or `lung-small` what
        [`delucax.studies.lung_study`][] writes, which goes on there if it was cut off.
    - `small`: fewer seeds and steps; false by default.
    - `say`: what to do with a line of text; `print` by default.

    **Returns:** a row for each claim: `study`, `claim`, `measured`, `holds`.

    **Raises:** `ValueError` if a name is not one of these; `OSError` if the folder
    cannot be written; `ImportError` without pandas or Matplotlib.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021.

    !!! example

        ```python
        import tempfile
        from delucax import experiments

        with tempfile.TemporaryDirectory() as folder:
            claims = studies.reproduce("wall-clock", folder, small=True)
        ```
    """
    pd = extra("pandas", "reproduce")
    extra("matplotlib", "reproduce").use("agg")
    chosen = [names] if isinstance(names, str) else list(names)
    for name in chosen:
        if name != "all" and name not in STUDIES:
            raise ValueError(
                f"reproduce: names must be 'all' or among {', '.join(STUDIES)}; got "
                f"{name!r}."
            )
    chosen = list(STUDIES) if "all" in chosen else chosen
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    sections, rows, begun = [], [], time.perf_counter()
    for k, name in enumerate(chosen):
        say(f"[{k + 1}/{len(chosen)}] {name}")
        start = time.perf_counter()
        options = {}
        if name == "ventilator":
            folder = out / ("lung-small" if small else "lung")
            options = {"out": folder, "say": say}
        try:
            found = STUDIES[name](small, **options)
        except Exception as error:
            (out / f"{name}.txt").write_text(traceback.format_exc())
            failed = Claim("The study runs", f"{type(error).__name__}: {error}", False)
            found = Finding(name, [failed], notes=f"The traceback is in {name}.txt.")
        for claim in found.claims:
            say(f"  {'holds' if claim.holds else 'DOES NOT HOLD'}: {claim.statement}")
            say(f"    {claim.measured}")
            rows.append(
                {
                    "study": name,
                    "claim": claim.statement,
                    "measured": claim.measured,
                    "holds": claim.holds,
                }
            )
        for title, figure in found.figures.items():
            if not isinstance(figure, Path):
                figure.savefig(out / f"{title}.png", dpi=150)
        sections.append(_section(found))
        pd.DataFrame(rows).to_csv(out / "claims.csv", index=False)
        (out / "report.html").write_text(_page(sections, rows))
        say(f"  {time.perf_counter() - start:.0f} s")
    held = sum(row["holds"] for row in rows)
    say(
        f"{held} of {len(rows)} claims hold; {out / 'report.html'}, in "
        f"{time.perf_counter() - begun:.0f} s"
    )
    return rows


def _page(sections: list[str], rows: list[dict[str, Any]]) -> str:
    found = provenance(Path())
    versions = ", ".join(f"{k} {v}" for k, v in found["versions"].items() if v)
    made = f"{found['date'][:10]}; commit {found['commit']}; {device()}; {versions}"
    held = sum(row["holds"] for row in rows)
    title = "The Deluca paper, reproduced"
    body = [f"<h1>{title}</h1>", f"<p>{held} of {len(rows)} claims hold.</p>"]
    body += [*sections, f"<p class='made'>{html.escape(made)}</p>"]
    return _document(title, body)


def _section(found: Finding) -> str:
    """What a study found, drawn once: figures take as long as some studies."""
    body = [f"<h2>{html.escape(found.title)}</h2>"]
    for claim in found.claims:
        word = "holds" if claim.holds else "does not hold"
        kind = "" if claim.holds else " class='bad'"
        body.append(
            f"<p><b{kind}>{word}</b>: {html.escape(claim.statement)}. Measured: "
            f"{html.escape(claim.measured)}.</p>"
        )
    for figure in found.figures.values():
        drawn = _image if isinstance(figure, Path) else _svg
        body.append(f"<figure>{drawn(figure)}</figure>")
    for title, table in found.tables.items():
        columns = list(table[0])
        values = [[row.get(column) for column in columns] for row in table]
        body += [f"<h3>{html.escape(title)}</h3>", _table(columns, values)]
    body.append(f"<p class='made'>{html.escape(found.notes)}</p>")
    return "\n".join(body)


def _svg(figure: Any) -> str:
    import matplotlib.pyplot as plt

    text = io.StringIO()
    figure.savefig(text, format="svg")
    plt.close(figure)
    return text.getvalue()[text.getvalue().index("<svg") :]


def _image(path: Path) -> str:
    content = base64.b64encode(path.read_bytes()).decode()
    kind = path.suffix.removeprefix(".")
    return f'<img src="data:image/{kind};base64,{content}" alt="{path.stem}">'
