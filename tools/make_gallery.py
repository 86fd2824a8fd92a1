"""Put four pictures of a result together for the README and the first page of the docs.

``glintrack run braunschweig -o RESULT``, then
``python tools/make_gallery.py RESULT docs/gallery/braunschweig.jpg``.
"""

import sys
from pathlib import Path

from PIL import Image

from glintrack.results.read import picture_file

WIDTH_PX = 1100
GAP_PX = 10
ROWS = (("view_rgb", "view_dolp"), ("pan", "dolp"))  # as the aircraft sees it; rectified, with tracks


def main(result: Path, output: Path) -> None:
    """Natural colour and DoLP as the aircraft sees them; below, rectified, with tracks of pan and DoLP."""
    rows = [[_picture(result, name) for name in names] for names in ROWS]
    heights = [max(picture.height for picture in row) for row in rows]
    size = 2 * WIDTH_PX + GAP_PX, sum(heights) + GAP_PX
    sheet = Image.new("RGB", size, "white")
    for k, row in enumerate(rows):
        for j, picture in enumerate(row):
            down = sum(heights[:k]) + k * GAP_PX + (heights[k] - picture.height) // 2
            sheet.paste(picture, (j * (WIDTH_PX + GAP_PX), down))
    sheet.save(output, quality=85)
    print(f"wrote {output}")


def _picture(result: Path, name: str) -> Image.Image:
    """One of a run's pictures, as wide as a column."""
    path = picture_file(result, name)
    if path is None:
        raise ValueError(f"`RESULT` must hold pictures/{name}.png; got none in {result}")
    with Image.open(path) as stored:
        picture = stored.convert("RGB")
    height = round(WIDTH_PX * picture.height / picture.width)
    return picture.resize((WIDTH_PX, height), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
