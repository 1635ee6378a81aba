"""The animations of the gallery, drawn by the code that its page shows.

`python docs/figures/gallery.py` runs the Python blocks of `docs/gallery.md` and puts
what they draw into `docs/assets/gallery/`, in a few minutes; with names of tasks, those
alone: `python docs/figures/gallery.py cartpole lorenz`.
"""

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path


DOCS = Path(__file__).parents[1]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def draw(names, folder, wrap=lambda film: film):
    """Run the first block of the page, and those that make the pictures of `names`, or
    all of them, in `folder`, by `wrap` of the page's `film`; returns the files."""
    first, *blocks = BLOCK.findall((DOCS / "gallery.md").read_text())
    namespace = {"__name__": "gallery"}
    exec(compile(first, "gallery.md", "exec"), namespace)
    namespace["film"] = wrap(namespace["film"])
    os.chdir(folder)
    for block in blocks:
        (name,) = re.findall(r'film\("(\w+)"', block)
        if not names or name in names:
            exec(compile(block, f"gallery.md: {name}", "exec"), namespace)
    return sorted(Path(folder).glob("*.gif"))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for path in draw(sys.argv[1:], folder):
            print(f"{path.stem}: {path.stat().st_size / 1000:.0f} kB")
            shutil.copy(path, DOCS / "assets" / "gallery" / path.name)
        os.chdir(DOCS)
