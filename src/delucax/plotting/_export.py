"""Frames as files and as a page: GIF, HTML and MP4."""

import base64
import hashlib
import html
import io
import os
import pathlib
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import matplotlib
import numpy as np
from PIL import Image

from ._figure import quantised


ENDINGS = (".gif", ".html", ".mp4")
CLEAR = 63  # the palette's index that stands for "as in the first frame"


def check_path(path: Any, where: str) -> pathlib.Path:
    """`path` as a file that can be written, or an error, before anything is drawn."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"{where}: path must be a path, got {path!r}.")
    path = pathlib.Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(
            f"{where}: path must end in {', '.join(ENDINGS)}, got {str(path)!r}."
        )
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(
            f"{where}: path must be a file in a folder that is there, got "
            f"{str(path)!r}."
        )
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ValueError(f"{where}: path cannot be written to, got {str(path)!r}.")
    if path.suffix.lower() == ".mp4" and shutil.which(_ffmpeg()) is None:
        raise ValueError(
            f"{where}: path ends in .mp4, which needs the program ffmpeg; install it, "
            "or save a .gif or .html."
        )
    return path


def _ffmpeg() -> str:
    return matplotlib.rcParams["animation.ffmpeg_path"]


def few_colours(
    colours: np.ndarray, counts: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """A palette of at most `most` colours, and the entry in it for each of `colours`.

    Those that are seen most are kept as they are: a tint where something was in the
    frame before would be a ghost of it.
    """
    if len(colours) <= most:
        return np.arange(len(colours)), colours
    order = np.argsort(-counts, kind="stable")
    common, rest = order[: most // 2], order[most // 2 :]
    image = quantised(Image.fromarray(colours[rest][None]), most - len(common))
    indices = np.empty(len(colours), int)
    indices[common] = np.arange(len(common))
    indices[rest] = len(common) + np.asarray(image)[0]
    table = np.reshape(image.getpalette(), (-1, 3))[: most - len(common)]
    return indices, np.concatenate([colours[common], table.astype(np.uint8)])


def _colours(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The colours of pixels `(..., 3)`, which of them each pixel has, and how often
    each is seen."""
    packed = pixels.reshape(-1, 3).astype(int) @ np.array([65536, 256, 1])
    packed, index, counts = np.unique(packed, return_inverse=True, return_counts=True)
    colours = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=-1)
    return colours.astype(np.uint8), index.reshape(pixels.shape[:-1]), counts


def _image(indices: np.ndarray, table: np.ndarray) -> Image.Image:
    image = Image.fromarray(indices.astype(np.uint8))
    image.putpalette(table.ravel().tolist())
    return image


def compressed(frames: Iterable[np.ndarray]) -> list[Image.Image]:
    """Frames of shape `(height, width, 3)` in few colours: the first whole, the others
    transparent where they are as the first, so that a page of them is small."""
    images: list[Image.Image] = []
    first: np.ndarray | None = None
    for frame in frames:
        if first is None:
            first = frame
            colours, which, counts = _colours(frame)
            entry, table = few_colours(colours, counts, 255)
            images.append(_image(entry[which], table))
            continue
        changed = np.any(frame != first, axis=-1)
        indices = np.full(frame.shape[:2], CLEAR)
        colours, which, counts = _colours(frame[changed])
        entry, table = few_colours(colours, counts, CLEAR)
        indices[changed] = entry[which]
        # Filled up to the clear colour: a PNG knows only of those in its palette.
        image = _image(indices, np.resize(table, (CLEAR + 1, 3)))
        image.info["transparency"] = CLEAR
        images.append(image)
    return images


def expanded(images: Sequence[Image.Image]) -> Iterator[Image.Image]:
    """The whole frames, in full colour, that were compressed."""
    first = images[0].convert("RGBA")
    for image in images:
        yield Image.alpha_composite(first, image.convert("RGBA")).convert("RGB")


def write(path: pathlib.Path, frames: Sequence[Image.Image], fps: float) -> None:
    """Write frames in the form that the ending of `path` names."""
    ending = path.suffix.lower()
    if ending == ".gif":
        _write_gif(path, frames, fps)
    elif ending == ".html":
        page = (
            '<!doctype html><html lang="en"><meta charset="utf-8">'
            f"<title>{html.escape(path.stem)}</title>"
            f"<body>{html_player(frames, fps)}</body></html>\n"
        )
        path.write_text(page, encoding="utf-8")
    else:
        _write_mp4(path, frames, fps)


def _write_gif(path, frames, fps):
    # One palette for all frames, so that nothing flickers.
    indices = [np.asarray(image) for image in frames]
    tables = [np.resize(image.getpalette(), (256, 3)) for image in frames]
    seen = [np.bincount(index.ravel(), minlength=256) for index in indices]
    for count in seen[1:]:
        count[CLEAR] = 0
    colours, which, _ = _colours(np.stack(tables))
    counts = np.bincount(which.ravel(), np.stack(seen).ravel(), len(colours))
    used = np.flatnonzero(counts)
    entry = np.zeros(len(colours), int)
    entry[used], palette = few_colours(colours[used], counts[used], 256)
    first = entry[which[0]][indices[0]]
    images = [_image(first, palette)]
    for index, look_up in zip(indices[1:], entry[which[1:]], strict=True):
        images.append(_image(np.where(index == CLEAR, first, look_up[index]), palette))
    # The format counts in hundredths of a second; browsers take less than 2 for 10.
    duration = max(20, 10 * round(100 / fps))
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=duration,
        loop=0,
        optimize=True,
    )


def _write_mp4(path, frames, fps):
    width, height = frames[0].size
    command = [_ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6g}"]
    # The pixel format that every player knows needs even sizes.
    even = "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"
    command += ["-i", "-", "-vf", even, "-pix_fmt", "yuv420p", str(path)]
    data = b"".join(image.tobytes() for image in expanded(frames))
    done = subprocess.run(command, input=data, capture_output=True)
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip()
        raise RuntimeError(f"ffmpeg could not write {str(path)!r}: {words[-500:]}")


# The script waits a moment: some notebooks run it before the rest is on the page.
_PLAYER = """\
<div class="delucax-animation" id="%(id)s" style="max-width:%(width)dpx">
<div style="position:relative">
<img alt="animation" src="data:image/png;base64,%(first)s"
 style="width:100%%;display:block;margin:0">
<img alt="" hidden style="width:100%%;position:absolute;left:0;top:0;margin:0"></div>
<div style="display:flex;align-items:center;gap:8px">
<button type="button" style="width:4.5em">Pause</button>
<input type="range" min="0" max="%(last)d" value="0" step="1" aria-label="frame"
 style="flex:1"></div></div>
<script>
setTimeout(() => {
  const frames = [%(frames)s];
  for (const root of document.querySelectorAll("#%(id)s:not([data-ready])")) {
    root.dataset.ready = "1";
    const [change, button, slider] =
      ["img[hidden]", "button", "input"].map((name) => root.querySelector(name));
    let timer = null;
    const show = (i) => {
      slider.value = i;
      if (i > 0) change.src = "data:image/png;base64," + frames[i - 1];
      change.hidden = i === 0;
    };
    const next = () => {
      if (!root.isConnected) clearInterval(timer);
      else show((Number(slider.value) + 1) %% (frames.length + 1));
    };
    const play = (on) => {
      clearInterval(timer);
      timer = on ? setInterval(next, %(interval)g) : null;
      button.textContent = on ? "Pause" : "Play";
    };
    button.addEventListener("click", () => play(timer === null));
    slider.addEventListener("input", () => {
      play(false);
      show(Number(slider.value));
    });
    play(true);
  }
}, 0);
</script>
"""


def html_player(frames: Iterable[Image.Image], fps: float) -> str:
    """A player with a button and a slider, of compressed frames.

    It needs nothing from the network; Matplotlib's own has its icons from another site.
    """
    width, encoded = 0, []
    for image in frames:
        width = image.width
        buffer = io.BytesIO()
        image.save(buffer, "PNG")
        encoded.append(base64.b64encode(buffer.getvalue()).decode())
    # A name from the content: the same animation makes the same page.
    name = hashlib.sha256("".join(encoded).encode()).hexdigest()[:12]
    return _PLAYER % {
        "id": f"delucax-{name}",
        "width": width,
        "first": encoded[0],
        "last": len(encoded) - 1,
        "frames": ",".join(f'"{e}"' for e in encoded[1:]),
        "interval": 1000 / fps,
    }
