"""Put two pictures of a result side by side for the README.

``glintrack run braunschweig -o RESULT``, then
``python scripts/make_gallery.py RESULT docs/gallery/braunschweig.jpg``.
"""

import sys
from pathlib import Path

from PIL import Image

HEIGHT_PX = 620
BORDER_PX = 6


def main(result: Path, output: Path) -> None:
    """Natural colour as the aircraft sees it, beside its degree of linear polarization."""
    pictures = [
        Image.open(result / "pictures" / name).convert("RGB") for name in ("view_rgb.png", "view_dolp.png")
    ]
    scaled = [p.resize((round(p.width * HEIGHT_PX / p.height), HEIGHT_PX), Image.LANCZOS) for p in pictures]
    width = sum(p.width for p in scaled) + BORDER_PX
    sheet = Image.new("RGB", (width, HEIGHT_PX), "white")
    sheet.paste(scaled[0], (0, 0))
    sheet.paste(scaled[1], (scaled[0].width + BORDER_PX, 0))
    sheet.save(output, quality=88)
    print(f"wrote {output}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
