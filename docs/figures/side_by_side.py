"""Join several videos of the same episode to a GIF, each below its name.

python docs/figures/side_by_side.py docs/_static/door.gif "Gaussian source=gaussian.mp4" "WP-Past=past.mp4"

It plays at a third of real speed. A video that ends before the others keeps its last picture.
"""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from warmprior.io.extras import require

RATE = 12  # pictures per second
SLOWER = 3
BAR = 30  # height of the names, in pixels


def pictures(path: Path) -> list[Image.Image]:
    """Return the pictures of the slowed video, :data:`RATE` per second."""
    av = require("av", "lerobot")
    with av.open(str(path)) as video:
        rate = float(video.streams.video[0].average_rate)
        frames = [frame.to_image() for frame in video.decode(video=0)]
    step = rate / SLOWER / RATE  # frames of the video per picture
    return [frames[min(round(k * step), len(frames) - 1)] for k in range(int(len(frames) / step) + 1)]


def main(out: str, *videos: str) -> None:
    """Write the GIF."""
    names = [video.split("=")[0] for video in videos]
    columns = [pictures(Path(video.split("=", 1)[1])) for video in videos]
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 15)
    side, length = columns[0][0].width, max(map(len, columns))
    joined = []
    for k in range(length):
        page = Image.new("RGB", (side * len(videos), side + BAR), "white")
        draw = ImageDraw.Draw(page)
        for column, (name, frames) in enumerate(zip(names, columns, strict=True)):
            page.paste(frames[min(k, len(frames) - 1)], (column * side, BAR))
            draw.text((column * side + 8, 6), name, fill="black", font=font)
        joined.append(page)
    palette = joined[length // 2].quantize(128, Image.Quantize.MEDIANCUT)
    reduced = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in joined]
    durations = [1000 // RATE] * (length - 1) + [1500]
    reduced[0].save(out, save_all=True, append_images=reduced[1:], duration=durations, loop=0, optimize=True)
    print(f"{out}: {Path(out).stat().st_size:,} bytes, {length} pictures")


if __name__ == "__main__":
    main(*sys.argv[1:])
