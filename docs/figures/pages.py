"""The pictures of the pages, drawn by the code that the pages show.

`python docs/figures/pages.py` runs the Python blocks of the pages below, or of those
that are named, and puts what they draw, in fewer colours, into `docs/assets/`, in a few
minutes. The numbers that they print go to `pages.json` beside this file, by page and by
the word or the whole number that the line begins with.
"""

import contextlib
import io
import json
import os
import re
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

from PIL import Image


DOCS = Path(__file__).parents[1]
PICTURES = {
    "first_system.md": ["first_system.png", "van_der_pol.png"],
    "events.md": ["bounces.png", "wheel.png"],
    "gradients.md": [],
    "linear_analysis.md": ["bode.png", "nyquist.png", "root_locus.png"],
}
NUMBERS = DOCS / "figures" / "pages.json"


def run(page, folder):
    """Run the blocks of a page in `folder`, in one namespace; what they print."""
    fenced = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    os.chdir(folder)
    namespace = {"__name__": "page"}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        for block in fenced.findall(page.read_text()):
            exec(compile(block, str(page), "exec"), namespace)
    return printed.getvalue()


def numbers(printed):
    """The numbers of each line that begins with a word or a whole number."""
    lines = re.findall(r"^([A-Za-z]\w*|\d+):? (.*)$", printed, re.MULTILINE)
    return {
        word: [float(n) for n in re.findall(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", rest)]
        for word, rest in lines
    }


if __name__ == "__main__":
    wanted = sys.argv[1:] or list(PICTURES)
    found = json.loads(NUMBERS.read_text())["printed"] if sys.argv[1:] else {}
    for name in wanted:
        with tempfile.TemporaryDirectory() as folder:
            found[name] = numbers(run(DOCS / name, folder))
            for picture in PICTURES[name]:
                drawn = Image.open(Path(folder) / picture).convert("RGB")
                small = drawn.quantize(128, dither=Image.Dither.NONE)
                small.save(DOCS / "assets" / picture, optimize=True)
            os.chdir(DOCS)
    made = {"versions": {name: version(name) for name in ("delucax", "jax")}}
    NUMBERS.write_text(json.dumps(made | {"printed": found}, indent=2) + "\n")
