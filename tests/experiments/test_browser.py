"""The report in a browser: it sorts, shows its figures and fits a phone."""

import html
import json
import re
import shutil
import subprocess

import pytest
from helpers import once

from delucax import experiments
from delucax.experiments import experiment


NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)
pytestmark = [
    once,
    pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(NAMES)} is here"),
]


@experiment.parametrize("kind", ["b", "a"])
@experiment.parametrize("size", [10, 9, 100])
@experiment.seeds(3)
def sweep(kind, size, seed):
    if (kind, size) == ("a", 9):
        raise ArithmeticError("nine <is> bad")
    return {"cost": size * (seed + 1.0)}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    experiments.report(experiments.run(sweep, progress=False), path, title="A <sweep>")
    return path


def seen(report, script, size=(1200, 900)):
    """What a script that ends the page gives back, as JSON, and that nothing failed."""
    source = report.read_text()
    say = "document.body.append(Object.assign(document.createElement('pre'), "
    say += f"{{id: 'said', textContent: JSON.stringify((() => {{{script}}})())}}));"
    page = report.with_name("asked.html")
    page.write_text(source.replace("</body>", f"<script>{say}</script></body>"))
    assert page.read_text() != source
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu"]
    command += ["--disable-dev-shm-usage", "--enable-logging=stderr", "--dump-dom"]
    command += [f"--user-data-dir={report.parent / 'profile'}"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND"]
    command += [f"--window-size={size[0]},{size[1]}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "CONSOLE" not in done.stderr, done.stderr
    said = re.search(r'<pre id="said">(.*?)</pre>', done.stdout, re.DOTALL)
    assert said, done.stderr
    return json.loads(html.unescape(said.group(1)))


def test_tables_sort_by_number_and_by_name(report):
    script = """
      const table = document.querySelector('table.sortable');
      const heads = [...table.tHead.rows[0].cells];
      const at = heads.map(head => head.textContent);
      const column = name => [...table.tBodies[0].rows].map(
        row => row.cells[at.indexOf(name)].textContent);
      const click = name => heads[at.indexOf(name)].firstElementChild.click();
      const found = {start: column('size')};
      click('size'); found.up = column('size');
      found.sort = heads[at.indexOf('size')].getAttribute('aria-sort');
      click('size'); found.down = column('size');
      click('kind'); found.kinds = column('kind');
      click('cost'); found.costs = column('cost');
      return found;
    """
    found = seen(report, script)
    assert found["start"] == ["10", "9", "100"] * 2
    assert found["up"] == ["9", "9", "10", "10", "100", "100"]
    assert found["sort"] == "ascending"
    assert found["down"] == found["up"][::-1]
    assert found["kinds"] == ["a"] * 3 + ["b"] * 3
    # What failed has no cost: it comes last.
    assert found["costs"] == ["18", "20", "20", "200", "200", ""]


def test_figures_are_drawn_and_a_phone_scrolls_only_the_tables(report):
    script = """
      document.querySelectorAll('details').forEach(part => part.open = true);
      const figures = [...document.querySelectorAll('figure > *')];
      return {
        title: document.title,
        figures: figures.map(figure => figure.getBoundingClientRect().width),
        rows: [...document.querySelectorAll('tbody')].map(body => body.rows.length),
        page: document.documentElement.scrollWidth, window: innerWidth,
        failure: document.querySelector('details summary.bad').textContent,
      };
    """
    found = seen(report, script, size=(500, 900))
    assert found["title"] == "A <sweep>"
    assert found["figures"] and all(200 < width < 500 for width in found["figures"])
    assert found["rows"] == [6, 18]
    assert found["page"] <= found["window"] <= 500
    assert "nine <is> bad" in found["failure"]


def test_nothing_is_fetched(report):
    assert not re.search(
        r"(?:src|href)=.?(?:https?:)?//|@import|url\((?!#)", report.read_text()
    )
