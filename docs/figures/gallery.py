"""Copy pictures and videos of runs to the gallery's page, as small files that look the same.

python docs/figures/gallery.py runs/budget/budget.png              # keeps its name in docs/_static/gallery
python docs/figures/gallery.py runs/can-ph-quick/success.png success_can.png

Pictures get at most 1400 pixels in width and a palette of 256 colours. Videos are unchanged, except that the
index moves to the front, so that browsers play before the download ends (needs PyAV).
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from warmprior.io.extras import require

OUT = Path(__file__).parents[1] / "_static" / "gallery"
WIDTH = 1400


def reduce_picture(source: Path, target: Path) -> None:
    """Write the picture with fewer pixels and colours."""
    with Image.open(source) as picture:
        image = picture.convert("RGB")
    if image.width > WIDTH:
        image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.LANCZOS)
    # Dithering hides the palette in photographs, but blurs lines on white.
    photograph = source.name.startswith("filmstrip")
    dither = Image.Dither.FLOYDSTEINBERG if photograph else Image.Dither.NONE
    palette = image.quantize(256, Image.Quantize.MAXCOVERAGE)  # a small can keeps its red
    reduced = image.quantize(palette=palette, dither=dither)
    colours, paper = reduced.getpalette(), reduced.getpixel((0, 0))
    colours[3 * paper : 3 * paper + 3] = 255, 255, 255  # white, not the mean of nearly white
    reduced.putpalette(colours)
    reduced.save(target, optimize=True)


def copy_video(source: Path, target: Path) -> None:
    """Write the same frames with the index in front."""
    av = require("av", "lerobot")
    options = {"movflags": "faststart"}
    with av.open(str(source)) as read, av.open(str(target), "w", options=options) as written:
        stream = written.add_stream_from_template(read.streams.video[0])
        for packet in read.demux(read.streams.video[0]):
            if packet.dts is not None:  # the last packet only flushes
                packet.stream = stream
                written.mux(packet)


def main(source: str, name: str | None = None) -> None:
    """Copy a file to the page's folder."""
    path = Path(source)
    target = OUT / (name or path.name)
    OUT.mkdir(exist_ok=True)
    (copy_video if path.suffix == ".mp4" else reduce_picture)(path, target)
    print(f"{target}: {target.stat().st_size:,} bytes, from {path.stat().st_size:,}")


if __name__ == "__main__":
    main(*sys.argv[1:])
