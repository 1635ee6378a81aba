"""The pictures of the pages, drawn by the code that the pages show.

`python docs/figures/pages.py` runs the Python blocks of the pages below and
puts what they draw, in fewer colours, into `docs/assets/`, in a few minutes.
"""

import os
import re
import tempfile
from pathlib import Path

from PIL import Image


DOCS = Path(__file__).parents[1]
PICTURES = {
    "index.md": ["van_der_pol.png"],
    "first_system.md": ["first_system.png"],
    "linear_analysis.md": ["bode.png", "nyquist.png", "root_locus.png"],
}


def run(page, folder):
    """Run the blocks of a page in `folder`, in one namespace."""
    fenced = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    os.chdir(folder)
    namespace = {"__name__": "page"}
    for block in fenced.findall(page.read_text()):
        exec(compile(block, str(page), "exec"), namespace)


if __name__ == "__main__":
    for name, pictures in PICTURES.items():
        with tempfile.TemporaryDirectory() as folder:
            run(DOCS / name, folder)
            for picture in pictures:
                drawn = Image.open(Path(folder) / picture).convert("RGB")
                small = drawn.quantize(128, dither=Image.Dither.NONE)
                small.save(DOCS / "assets" / picture, optimize=True)
            os.chdir(DOCS)
