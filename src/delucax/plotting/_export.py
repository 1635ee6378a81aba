"""Writes frames to GIF, HTML and MP4 files."""

import base64
import hashlib
import html
import io
import os
import shutil
import string
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np
from jaxtyping import Int, Num, UInt8
from PIL import Image

from .._check import as_path
from .._figures import quantised


Pixels: TypeAlias = UInt8[np.ndarray, "... 3"]
Indices: TypeAlias = Int[np.ndarray, "..."]
Palette: TypeAlias = UInt8[np.ndarray, "_ 3"]

TRANSPARENT = 63  # the entry of the palette that means "as in the first frame"
# The script is deferred: some notebooks run it before the page's elements exist.
PLAYER = string.Template(Path(__file__).with_name("_player.html").read_text("utf-8"))


def check_path(path: Any, where: str) -> Path:
    """Return `path` as a `Path`, or raise an error if it cannot be written."""
    path = as_path(path, "path", where)
    if path.suffix.lower() not in _WRITERS:
        raise ValueError(
            f"{where}: path must end in {', '.join(_WRITERS)}, got {str(path)!r}."
        )
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(
            f"{where}: path must be a file in an existing folder, got {str(path)!r}."
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


def reduced_palette(
    colours: Palette, counts: Num[np.ndarray, " _"], most: int
) -> tuple[Indices, Palette]:
    """Reduce `colours` to a palette of at most `most`. Returns the entry of the palette
    for each colour, and the palette.

    The most frequent colours are kept exactly. Rounded colours would leave ghosts of
    earlier frames.
    """
    if len(colours) <= most:
        return np.arange(len(colours)), colours
    common, rest = np.split(np.argsort(-counts, kind="stable"), [most // 2])
    image = quantised(Image.fromarray(colours[rest][None]), most - len(common))
    entries = np.empty(len(colours), int)
    entries[common] = np.arange(len(common))
    entries[rest] = len(common) + np.asarray(image)[0]
    table = np.reshape(image.getpalette(), (-1, 3))[: most - len(common)]
    return entries, np.concatenate([colours[common], table.astype(np.uint8)])


def _distinct(pixels: Pixels) -> tuple[Palette, Indices, Indices]:
    """The distinct colours of pixels, the index of the colour of each pixel, and the
    number of pixels of each colour."""
    packed = pixels.reshape(-1, 3).astype(int) @ np.array([65536, 256, 1])
    packed, index, counts = np.unique(packed, return_inverse=True, return_counts=True)
    colours = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=-1)
    return colours.astype(np.uint8), index.reshape(pixels.shape[:-1]), counts


def _reduced(pixels: Pixels, most: int) -> tuple[Indices, Palette]:
    """Pixels as entries in a palette of at most `most` colours."""
    colours, index, counts = _distinct(pixels)
    entries, palette = reduced_palette(colours, counts, most)
    return entries[index], palette


def _image(entries: Int[np.ndarray, "height width"], palette: Palette) -> Image.Image:
    image = Image.fromarray(entries.astype(np.uint8))
    image.putpalette(palette.ravel().tolist())
    return image


def compressed(frames: Iterable[Pixels]) -> list[Image.Image]:
    """Frames with few colours, from frames of shape `(height, width, 3)`. All but the
    first are transparent where they equal the first, so that a page is small."""
    frames = iter(frames)
    first = next(frames)
    images = [_image(*_reduced(first, 255))]
    for frame in frames:
        changed = np.any(frame != first, axis=-1)
        entries = np.full(changed.shape, TRANSPARENT)
        entries[changed], palette = _reduced(frame[changed], TRANSPARENT)
        # A PNG can use only entries of its palette, so it must reach TRANSPARENT.
        image = _image(entries, np.resize(palette, (TRANSPARENT + 1, 3)))
        image.info["transparency"] = TRANSPARENT
        images.append(image)
    return images


def expanded(images: Sequence[Image.Image]) -> Iterator[Image.Image]:
    """Undo `compressed`: yield whole frames in full colour."""
    first = images[0].convert("RGBA")
    for image in images:
        yield Image.alpha_composite(first, image.convert("RGBA")).convert("RGB")


def write(path: Path, frames: Sequence[Image.Image], fps: float) -> None:
    """Write frames in the format that the ending of `path` names."""
    _WRITERS[path.suffix.lower()](path, frames, fps)


def _write_gif(path: Path, frames: Sequence[Image.Image], fps: float) -> None:
    # One palette for all frames, so that nothing flickers.
    entries = [np.asarray(image) for image in frames]
    tables = [np.resize(image.getpalette(), (256, 3)) for image in frames]
    used = np.stack([np.bincount(entry.ravel(), minlength=256) for entry in entries])
    used[1:, TRANSPARENT] = 0
    colours, which, _ = _distinct(np.stack(tables).astype(np.uint8))
    counts = np.bincount(which.ravel(), used.ravel(), len(colours))
    present = np.flatnonzero(counts)
    shared = np.zeros(len(colours), int)
    shared[present], palette = reduced_palette(colours[present], counts[present], 256)
    first = shared[which[0]][entries[0]]
    images = [_image(first, palette)]
    for entry, table in zip(entries[1:], shared[which[1:]], strict=True):
        entry = np.where(entry == TRANSPARENT, first, table[entry])
        images.append(_image(entry, palette))
    # GIF counts hundredths of a second, and browsers take a value below 2 as 10.
    options = {"duration": max(20, 10 * round(100 / fps)), "loop": 0, "optimize": True}
    images[0].save(path, save_all=True, append_images=images[1:], **options)


def _write_html(path: Path, frames: Sequence[Image.Image], fps: float) -> None:
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>{html.escape(path.stem)}</title>"
        f"<body>{html_player(frames, fps)}</body></html>\n"
    )
    path.write_text(page, encoding="utf-8")


def _write_mp4(path: Path, frames: Sequence[Image.Image], fps: float) -> None:
    width, height = frames[0].size
    command = [_ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6g}"]
    # yuv420p, the pixel format that every player knows, needs an even width and height.
    even = "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"
    command += ["-i", "-", "-vf", even, "-pix_fmt", "yuv420p", str(path)]
    data = b"".join(image.tobytes() for image in expanded(frames))
    process = subprocess.run(command, input=data, capture_output=True)
    if process.returncode:
        message = process.stderr.decode(errors="replace").strip()
        raise RuntimeError(f"ffmpeg could not write {str(path)!r}: {message[-500:]}")


_WRITERS = {".gif": _write_gif, ".html": _write_html, ".mp4": _write_mp4}


def html_player(frames: Sequence[Image.Image], fps: float) -> str:
    """The HTML of a player for compressed frames, with a button and a slider.

    It loads nothing from the network. Matplotlib's player loads its icons.
    """
    encoded = []
    for image in frames:
        buffer = io.BytesIO()
        image.save(buffer, "PNG")
        encoded.append(base64.b64encode(buffer.getvalue()).decode())
    # A hash of the frames as the name: the same animation makes the same page.
    name = hashlib.sha256("".join(encoded).encode()).hexdigest()[:12]
    return PLAYER.substitute(
        id=f"delucax-{name}",
        width=frames[0].width,
        first=encoded[0],
        last=len(encoded) - 1,
        frames=",".join(f'"{each}"' for each in encoded[1:]),
        interval=f"{1000 / fps:g}",
    )
