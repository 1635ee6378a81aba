"""The page with ours beside what is published."""

import json
from pathlib import Path
from typing import Any

from benchmarks._identified.case import KNOWN
from benchmarks._identified.published import RESULTS as PUBLISHED, SOURCES


PAGE = Path(__file__).parents[2] / "docs" / "identification_exam.md"
_HEAD = """# Identification on public data

This page shows three public benchmarks of nonlinear identification, with published
results beside ours, and a check of our intervals on simulated plants.
[Identification](identification.md) explains the methods.

```bash
python -m benchmarks.identification --data DIR           # fits what is not stored yet
python -m benchmarks.identification --data DIR --again   # fits all anew: over an hour
```

`DIR` is a folder with the data files that this page names. delucax does not include
these files, because they have no licence that allows us to distribute them.

Each model is fitted only to the estimation data, in double precision. The model is then
simulated on the test data with the recorded input, from a state that is estimated from
the first 50 samples. The error is the root mean square error over the samples after the
first 50. Networks are trained from ten seeds, and the table shows the median, the
smallest and the largest error.

- **linear** is `subspace` with an offset.
- **physics** fits only the parameters of the physical equations, and **grey box** also
  fits a network that is added to the derivatives of the states. The size that the
  correction by the network may have is chosen by a simulation of the last quarter of
  the estimation data. For Bouc-Wen this size is fixed.
- **neural state space** is `state_space` with its defaults and an encoder of 20
  samples. This model uses no physics, and none of its settings are tuned.

We chose the equations, the sizes of the networks and the windows of the grey boxes by
hand while we developed the models. After we had seen test errors, we changed two
things, both for Bouc-Wen:

- The first fits stopped after 50 iterations, before they had converged, with an error
  of 19 um on the multisine. Now these fits may take 150 iterations.
- Our first data generator applied the input too late, by half a step of the simulation.
  With these wrong data, the errors of the grey box were 9.2 um on the multisine and 6.2
  um on the sweep, and those of the fit of the published equations were 3.6 and 3.1 um.
  After we had corrected the generator, all models were fitted again.

The data are split into estimation and test data as in the package
`nonlinear_benchmarks` 1.0.1. Older published results may split the data in another way.
"""
_TITLES = {
    "tanks": (
        "Cascaded tanks",
        "A pump fills the upper of two tanks, which drains into the lower tank. Both "
        "tanks can overflow, and only the level of the lower tank is measured. The "
        "estimation data and the test data have 1,024 samples each, one every 4 s. The "
        "data are from [nonlinearbenchmark.org](https://www.nonlinearbenchmark.org) "
        "(Schoukens, Mattsson, Wigren and Noël, 2016). The file is "
        "`cascaded_tanks/dataBenchmark.csv`, with the columns `uEst`, `yEst`, `uVal` "
        "and `yVal`. The physical model contains Bernoulli's law, the overflow, an "
        "offset of the pump and the depth of the outlet. The error is in V.",
    ),
    "silverbox": (
        "Silverbox",
        "The Silverbox is an electronic circuit that behaves like an oscillator with a "
        "cubic spring. The data are from "
        "[nonlinearbenchmark.org](https://www.nonlinearbenchmark.org) (Wigren and "
        "Schoukens, 2013). The file is `SNLS80mV.csv` from the archive on that site, "
        "with the columns `V1` and `V2`. Compress this file, and store it as "
        "`silverbox/SNLS80mV.csv.gz`. There are three tests: the last quarter of the "
        'multisine signal, the whole arrow-shaped signal ("arrow"), and the part of '
        "the arrow-shaped signal whose amplitudes also occur in the estimation data "
        '("inside"). The error is in mV. Our models are fitted to the first 16,000 of '
        "the 65,062 samples.",
    ),
    "bouc_wen": (
        "Bouc-Wen",
        "Bouc-Wen is an oscillator with a hysteretic force (Noël and Schoukens, 2016). "
        "Our program generates the data from the published equations, constants and "
        "signals, so no file is needed. Our test records differ from the official "
        "ones, because the random phases and the integrator are our own. The physical "
        "model contains the oscillator and one hidden state for the hysteretic force. "
        'A network learns the derivative of the hysteretic force. In the row "physics" '
        "the derivative of the hysteretic force is proportional to the velocity. The "
        'model of the row "physics" is therefore linear, and has fewer parameters than '
        'the model of the row "linear". The error is in micrometres, and the noise of '
        "the estimation data is 8 micrometres. Our models are fitted to the first "
        "8,192 of the 40,960 samples.",
    ),
}


_BEST_SWEEP = min(errors.get("sweep", 9e9) for _, errors, _ in PUBLISHED["bouc_wen"])
_OTHERS = """## Your own files

With `--part others` the command fits the two models that need no physics to your own
data, and prints the errors of the models. Each data set is a folder `DIR/others/NAME`
with a file `estimation.csv` and one or more test files. The names of the columns begin
with `u` for inputs and with `y` for outputs. This code writes such files for another
data set of nonlinearbenchmark.org:

<!-- notest: needs a download -->
```python
import nonlinear_benchmarks
import pandas as pd

train, test = nonlinear_benchmarks.WienerHammerBenchMark()
for name, data in {"estimation": train, "test": test}.items():
    frame = pd.DataFrame({"u": data.u, "y": data.y})
    frame.to_csv(f"DIR/others/wiener_hammerstein/{name}.csv", index=False)
```
"""


def page(results: Path) -> None:
    """Write the page from the results."""
    if not results.exists():
        raise SystemExit(f"{results} is not there: run the benchmark first.")
    PAGE.write_text(written(results))


def written(results: Path) -> str:
    """The text of the page."""
    stored = json.loads(results.read_text())
    parts = [_HEAD, _summary(stored)]
    for name, (title, about) in _TITLES.items():
        parts.append(f"## {title}\n\n{about}\n\n{_table(name, stored[name])}")
    parts += [_OTHERS, _coverage(stored["coverage"]["rows"])]
    parts.append(
        "## Sources\n\n" + "\n".join(f"- {k}: {v}" for k, v in SOURCES.items())
    )
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _summary(stored: dict[str, Any]) -> str:
    """The medians of the grey boxes."""
    median = {
        (name, part): row[part]["median"]
        for name in _TITLES
        for row in stored[name]["rows"]
        if row["method"] == "grey box"
        for part in list(row)[2:]
    }
    (known,) = (r for r in stored["bouc_wen"]["rows"] if r["method"] == KNOWN)
    return (
        "In the median of ten seeds, the grey box (physics with a network) has an "
        f"error of {median['tanks', 'test']:.3f} V on the cascaded tanks, "
        f"{median['silverbox', 'multisine']:.3f} mV on the multisine of the Silverbox "
        f"and {median['silverbox', 'arrow']:.3f} mV on its arrow, and "
        f"{median['bouc_wen', 'multisine']:.1f} um on the multisine of Bouc-Wen. On "
        f"the sweep of Bouc-Wen the error of the grey box is "
        f"{median['bouc_wen', 'sweep']:.1f} um, "
        f"{median['bouc_wen', 'sweep'] / _BEST_SWEEP:.1f} times that of the published "
        "fit that uses the equation of the hysteresis. With the equation of the "
        "hysteresis, our own fit has an error of "
        f"{known['multisine']['median']:.2f} um on the multisine and "
        f"{known['sweep']['median']:.2f} um on the sweep."
    )


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
    title = _TITLES[name][0]
    lines.append(f"\nThe longest fit ({title}) took {seconds:.0f} s with compilation.")
    return "\n".join(lines)


def _entry(values: dict[str, float], several: bool) -> str:
    text = f"{values['median']:.3g}"
    ends = f" ({values['least']:.3g} to {values['most']:.3g})"
    return text + (ends if several else "")


def _coverage(rows: list[dict[str, Any]]) -> str:
    lines = [
        "## Intervals",
        "",
        "The table shows how often intervals of 95% contain the true parameters, on "
        f"{rows[0]['records']:,} simulated records of each plant. Each plant has a "
        "hidden state, and each record has 200 samples. The initial guess of each "
        "parameter is 20% off the true value. A fit counts as failed if it reports "
        "that it did not converge, or that the data do not determine a parameter. A "
        "failed fit has no intervals.",
        "",
        "The length of the window matters. A longer window gives more information "
        "about a hidden state. In a shorter window, a simulation with wrong "
        "parameters stays closer to the record. In this test the longer windows, which "
        "were chosen for each plant, are at least as good as the default window: for "
        "no plant do more fits fail. The first three rows of the table show the longer "
        "windows. In the first three rows, 92.5 to 97.5% of the intervals must contain "
        "the true parameters, and at most 1% of the fits may fail. The rows with the "
        "default window show what you get if you do not tune the window. In the row "
        '"tanks" the upper tank overflows in each record. In the row "tanks, seldom '
        'full" the upper tank seldom overflows, so the data contain less information '
        "about its level.",
        "",
        "| plant | window | covered, % | by parameter, % | failures, % |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        each = ", ".join(f"{share:.1f}" for share in row["each, %"])
        covered, failed = row["covered, %"], row["failures, %"]
        entries = row["plant"], f"{row['window']}", f"{covered:.1f}", each
        lines.append(f"| {' | '.join(entries)} | {failed:.1f} |")
    return "\n".join(lines)
