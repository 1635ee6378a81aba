"""The layers of the library as a picture, from the import contract in pyproject.toml.

`python docs/figures/layers.py` writes `docs/assets/layers.svg`, and a test compares the
two. The boxes are opaque, and what stands outside of them is grey, so that the picture
can be read on a light and on a dark page.
"""

import html
import tomllib
from pathlib import Path


ROOT = Path(__file__).parents[2]
PICTURE = ROOT / "docs" / "assets" / "layers.svg"

WIDTH, MARGIN, EDGE = 720, 12, 84
ROW, GAP, BOX_GAP = 34, 10, 8
LETTER = 8.1  # the width of one, in the font below
FONT = 'font-family="ui-monospace, Menlo, Consolas, monospace" font-size="13.5"'
PUBLIC = 'fill="#dfe6f6" stroke="#5b6fa8"'
PRIVATE = 'fill="#ececec" stroke="#8a8a8a"'
INK, GREY = "#1c2333", "#848484"
MOST = 6
"""A layer of more private modules shows them as one box."""


def layers(settings):
    """The names of the packages, layer by layer from the top; and those that all may
    import."""
    contracts = settings["tool"]["importlinter"]["contracts"]
    (stack,) = (c["layers"] for c in contracts if c["type"] == "layers")
    (ground,) = (c["ground"] for c in contracts if "ground" in c)
    return [[n.strip(" ()") for n in layer.split(":")] for layer in stack], set(ground)


def boxes(names, ground):
    """What is written into the boxes of a layer, and whether each is public."""
    hidden = [n for n in names if n.startswith("_") and n != "__main__"]
    if len(hidden) <= MOST:
        return [(name, not name.startswith("_")) for name in names]
    shown = [name for name in names if name not in hidden or name in ground]
    rest = f"{len(names) - len(shown)} private modules"
    return [*((name, not name.startswith("_")) for name in shown), (rest, False)]


def picture(settings):
    """The text of the picture."""
    stack, ground = layers(settings)
    parts, y = [], MARGIN
    for names in stack:
        row = boxes(names, ground)
        widths = [round(LETTER * len(name)) + 24 for name, _ in row]
        free = WIDTH - EDGE - MARGIN - sum(widths) - BOX_GAP * (len(row) - 1)
        x = EDGE + free // 2
        for (name, is_public), width in zip(row, widths, strict=True):
            style = PUBLIC if is_public else PRIVATE
            parts.append(
                f'<rect x="{x}" y="{y}" width="{width}" height="{ROW}" rx="5" {style}/>'
            )
            parts.append(
                f'<text x="{x + width / 2:g}" y="{y + ROW / 2 + 4.5:g}" {FONT} '
                f'fill="{INK}" text-anchor="middle">{html.escape(name)}</text>'
            )
            x += width + BOX_GAP
        y += ROW + GAP
    height = y - GAP + MARGIN
    low = height - MARGIN
    at = EDGE // 2
    arrow = (
        f'<path d="M{at} {MARGIN}V{low - 8}" stroke="{GREY}" stroke-width="2"/>\n'
        f'<path d="M{at - 6} {low - 10}h12l-6 10z" fill="{GREY}"/>\n'
        f'<text x="{at - 8}" y="{height / 2:g}" {FONT} fill="{GREY}" '
        f'text-anchor="middle" transform="rotate(-90 {at - 8} {height / 2:g})">'
        "imports only from below</text>"
    )
    title = "The packages of delucax in layers: each imports only from those below it"
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
            f'width="{WIDTH}" height="{height}" role="img">',
            f"<title>{title}</title>",
            arrow,
            *parts,
            "</svg>\n",
        ]
    )


def settings():
    """Those of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


if __name__ == "__main__":
    PICTURE.write_text(picture(settings()), encoding="utf-8")
