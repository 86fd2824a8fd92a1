"""Put four pictures of a result together for the README.

``glintrack run braunschweig -o RESULT``, then
``python scripts/make_gallery.py RESULT docs/gallery/braunschweig.jpg``.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from glintrack.report import Composite
from glintrack.results.read import read_result

WIDTH_PX = 980
BORDER_PX = 6
WHITE = 250
TOP = ("view_rgb", "view_dolp")  # as the aircraft sees it
BOTTOM = (("rgb", "pan"), ("dolp", "dolp"))  # on the ground, with whose tracks


def main(result: Path, output: Path) -> None:
    """Natural colour and DoLP as the aircraft sees them; below, rectified, with tracks of pan and DoLP."""
    found = read_result(result)
    pictures = [Image.open(result / "pictures" / f"{name}.png").convert("RGB") for name in TOP]
    pictures = [_without_frame(p) for p in pictures]
    for kind, channel in BOTTOM:
        film = Composite.of(found, (kind,), channel, WIDTH_PX)
        pictures.append(Image.fromarray(film.draw(3 * len(film) // 4)))
    height = round(WIDTH_PX * pictures[0].height / pictures[0].width)
    sheet = Image.new("RGB", (2 * WIDTH_PX + BORDER_PX, 2 * height + BORDER_PX), "white")
    for k, picture in enumerate(pictures):
        place = ((k % 2) * (WIDTH_PX + BORDER_PX), (k // 2) * (height + BORDER_PX))
        sheet.paste(picture.resize((WIDTH_PX, height), Image.Resampling.LANCZOS), place)
    sheet.save(output, quality=85)
    print(f"wrote {output}")


def _without_frame(picture: Image.Image) -> Image.Image:
    """The picture less the white border that a figure leaves around it."""
    drawn = np.asarray(picture.convert("L")) < WHITE
    return picture.crop(Image.fromarray(drawn).getbbox())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
