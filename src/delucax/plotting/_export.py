"""Frames as files and as a page: GIF, HTML and MP4."""

import base64
import hashlib
import html
import io
import os
import pathlib
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from typing import Any

import matplotlib
import numpy as np
from PIL import Image


ENDINGS = (".gif", ".html", ".mp4")


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


def reduced(frame: np.ndarray) -> Image.Image:
    """A frame, shape `(height, width, 3)`, in at most 64 colours of its own."""
    # Of Pillow's methods the one that keeps both thin grey lines and pure white.
    image = Image.fromarray(frame)
    return image.quantize(64, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)


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
    # One palette for all frames, from a mosaic of them: nothing flickers.
    mosaic = np.concatenate([np.asarray(f.convert("RGB"))[::3, ::3] for f in frames])
    palette = Image.fromarray(mosaic).quantize(255, Image.Quantize.MAXCOVERAGE)
    images = [
        f.convert("RGB").quantize(palette=palette, dither=Image.Dither.NONE)
        for f in frames
    ]
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
    data = b"".join(f.convert("RGB").tobytes() for f in frames)
    done = subprocess.run(command, input=data, capture_output=True)
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip()
        raise RuntimeError(f"ffmpeg could not write {str(path)!r}: {words[-500:]}")


_PLAYER = """\
<div class="delucax-animation" id="%(id)s" style="max-width:%(width)dpx">
<img alt="animation" src="data:image/png;base64,%(first)s"
 style="width:100%%;display:block">
<div style="display:flex;align-items:center;gap:8px">
<button type="button" style="width:4.5em">Pause</button>
<input type="range" min="0" max="%(last)d" value="0" step="1" aria-label="frame"
 style="flex:1"></div></div>
<script>
(() => {
  const frames = [%(frames)s];
  for (const root of document.querySelectorAll("#%(id)s:not([data-ready])")) {
    root.dataset.ready = "1";
    const [picture, button, slider] =
      ["img", "button", "input"].map((name) => root.querySelector(name));
    let timer = null;
    const show = (i) => {
      slider.value = i;
      picture.src = "data:image/png;base64," + frames[i];
    };
    const next = () => {
      if (!root.isConnected) clearInterval(timer);
      else show((Number(slider.value) + 1) %% frames.length);
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
})();
</script>
"""


def html_player(frames: Iterable[Image.Image], fps: float) -> str:
    """A player with a button and a slider that needs nothing from the network.

    Matplotlib's own loads its icons from another site.
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
        "frames": ",".join(f'"{e}"' for e in encoded),
        "interval": 1000 / fps,
    }
