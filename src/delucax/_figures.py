"""The style of figures, and figures in notebooks. It imports Matplotlib."""

import io
import re
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from PIL import Image


# The palette of Okabe and Ito (2008), which colour-blind readers can distinguish. Its
# yellow is left out because it vanishes on white paper, and its black because it
# vanishes on a dark page.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINE_STYLES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 1.5, 1, 1.5)))
NEUTRAL = "0.5"


class NotebookFigure(Figure):
    """A figure that a notebook shows even without a plotting backend."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        # Twice the pixels, shown at the nominal size, are sharp on a dense screen. Few
        # colours make the image a third as large, which matters in a saved notebook.
        buffer, small = io.BytesIO(), io.BytesIO()
        self.savefig(buffer, format="png", dpi=2 * self.dpi, transparent=False)
        image = quantised(Image.open(buffer).convert("RGB"), 255)
        image.save(small, "PNG", optimize=True)
        size = {"width": image.width // 2, "height": image.height // 2}
        return small.getvalue(), size


def quantised(image: Image.Image, colours: int) -> Image.Image:
    """An image in its main colours."""
    # The only one of Pillow's methods that keeps both thin pale lines and pure white.
    method = Image.Quantize.MAXCOVERAGE
    return image.quantize(colours, method, dither=Image.Dither.NONE)


def color_of(index: int) -> str:
    """The colour of line `index`. The palette repeats after six."""
    return PALETTE[index % len(PALETTE)]


def line_style(index: int) -> dict[str, Any]:
    """The colour and dashes of line `index`. The first six lines are solid."""
    dashes = LINE_STYLES[index // len(PALETTE) % len(LINE_STYLES)]
    return {"color": color_of(index), "linestyle": dashes}


def style_axes(ax: Axes, *, size: float, ticks: tuple[int, int] = (8, 4)) -> None:
    """Set a light grid, two spines, few ticks, and tick labels without an offset."""
    ax.grid(True, color=NEUTRAL, alpha=0.2, linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(NEUTRAL)
        ax.spines[side].set_linewidth(0.8)
    ax.tick_params(color=NEUTRAL, width=0.8, length=3, labelsize=size - 0.5)
    ax.margins(x=0.01)
    for axis, count in zip((ax.xaxis, ax.yaxis), ticks, strict=True):
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 2.5, 5, 10]))
        axis.set_major_formatter(ScalarFormatter(useOffset=False))


def with_unit(name: str, unit: str) -> str:
    """A label such as `"angle [rad]"`; the name alone if the unit is empty."""
    return f"{name} [{unit}]" if unit else name


def wrapped(text: str, width: int) -> str:
    """`text` in lines of about `width` characters, broken at spaces. Words that are
    longer than a line are broken after `_`. A text with mathematics is not broken.
    """
    if "$" in text:
        return text
    pieces = []
    for word in re.findall(r"[^ ]+ *", text):
        long = len(word.rstrip()) > width
        pieces += re.findall(r"[^_]+_*|_+", word) if long else [word]
    lines = [""]
    for piece in pieces:
        if lines[-1] and len(lines[-1] + piece.rstrip()) > width:
            lines.append("")
        lines[-1] += piece
    return "\n".join(line.rstrip() for line in lines)


def top_legend(
    figure: Figure, entries: Sequence[tuple[Line2D, str]], **style: Any
) -> None:
    """Add a legend above all panels; `entries` are pairs of a handle and its label."""
    handles, labels = zip(*entries, strict=True)
    place = {"loc": "outside upper center", "frameon": False}
    figure.legend(list(handles), list(labels), **place, **style)
