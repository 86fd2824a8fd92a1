"""What somebody may put in the place of a file: not one byte changed, but another thing altogether."""

import gzip
import os
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import rasterio
import rasterio.transform

_TEXT = (".toml", ".csv", ".xml", ".obj")
_MANY = 100_000


def _bytes(make: Callable[[bytes], bytes]) -> Callable[[Path, Path], None]:
    """A file whose bytes follow from the valid one's."""
    return lambda path, valid: _put(path, make(valid.read_bytes() if valid.is_file() else b"x"))


def _put(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _text(make: Callable[[str], str]) -> Callable[[Path, Path], None]:
    return lambda path, valid: _put(path, make(valid.read_text()).encode())


def _picture(path: Path, valid: Path) -> None:
    corner = rasterio.transform.from_origin(0, 10, 1, 1)
    about = {"height": 8, "width": 8, "count": 1, "dtype": "uint8", "transform": corner}
    with rasterio.open(path, "w", driver="PNG", **about) as file:
        file.write(np.ones((1, 8, 8), np.uint8))


def _huge_raster(path: Path, valid: Path) -> None:
    about = {"height": 300_000, "width": 300_000, "count": 1, "dtype": "float32", "sparse_ok": True}
    about |= {"tiled": True, "blockxsize": 32_768, "blockysize": 32_768, "bigtiff": "yes"}
    with rasterio.open(path, "w", driver="GTiff", compress="deflate", **about):
        pass


def _cells(value: str) -> Callable[[str], str]:
    """Every number of a table but in its header made another one."""
    number = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])")
    return lambda text: text.partition("\n")[0] + "\n" + number.sub(value, text.partition("\n")[2])


def _one_cell(value: str) -> Callable[[str], str]:
    """The last number of the file made another one."""
    return lambda text: re.sub(r"-?\d+(?:\.\d+)?(?!.*\d)", value, text, count=1, flags=re.DOTALL)


def _columns_twice(text: str) -> str:
    return "".join(f"{line},{line}\n" for line in text.splitlines())


def _lines_twice(text: str) -> str:
    head, *lines = text.splitlines(keepends=True)
    return head + "".join(line + line for line in lines)


def _negative_ids(text: str) -> str:
    return re.sub(r"^([^,;\n]*[,;])(\d+)", r"\1-\2", text, flags=re.MULTILINE)


def _bomb(valid: bytes) -> bytes:
    """300 MB of blanks in 300 kB."""
    packer = zlib.compressobj(9, wbits=31)
    return packer.compress(b" " * 300_000_000) + packer.flush()


# for every file
ANY: Mapping[str, Callable[[Path, Path], None]] = {
    "missing": lambda path, valid: None,
    "empty": _bytes(lambda valid: b""),
    "folder": lambda path, valid: path.mkdir(),
    "endless": lambda path, valid: path.symlink_to("/dev/zero"),
    "pipe": lambda path, valid: os.mkfifo(path),
    "terminal": lambda path, valid: path.symlink_to("/dev/tty"),
    "link to itself": lambda path, valid: path.symlink_to(path.name),
    "link to nothing": lambda path, valid: path.symlink_to("nowhere"),
    "noise": _bytes(lambda valid: np.random.default_rng(0).bytes(20_000)),
    "NULs": _bytes(lambda valid: bytes(100_000)),
    "picture": _picture,
    "huge raster": _huge_raster,
    "gzip bomb": _bytes(_bomb),
    "zipped": _bytes(gzip.compress),
    "half": _bytes(lambda valid: valid[: len(valid) // 2]),
    "HDF5's first bytes": _bytes(lambda valid: b"\x89HDF\r\n\x1a\n" + bytes(5000)),
    "virtual raster": _bytes(
        lambda valid: (
            b'<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1">'
            b"<SimpleSource><SourceFilename>/vsicurl/http://127.0.0.1:9/a.tif</SourceFilename></SimpleSource>"
            b"</VRTRasterBand></VRTDataset>"
        )
    ),
    "web page": _bytes(lambda valid: b"<!DOCTYPE html><html><body>404 not found</body></html>"),
    "one long line": _bytes(lambda valid: b"a" * 5_000_000),
    "deep JSON": _bytes(lambda valid: b"[" * _MANY),
    "deep XML": _bytes(lambda valid: b"<a>" * _MANY),
    "XML of entities": _bytes(
        lambda valid: (
            b'<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">'
            + b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k) * 10) for k in range(12))
            + b"]><net>&m;</net>"
        )
    ),
    "XML that reads a file": _bytes(
        lambda valid: b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><net>&b;</net>'
    ),
}
# for text
TEXT: Mapping[str, Callable[[Path, Path], None]] = {
    "UTF-16": _bytes(lambda valid: valid.decode().encode("utf-16")),
    "byte-order mark": _bytes(lambda valid: b"\xef\xbb\xbf" + valid),
    "CRLF": _bytes(lambda valid: valid.replace(b"\n", b"\r\n")),
    "CR": _bytes(lambda valid: valid.replace(b"\n", b"\r")),
    "latin-1": _bytes(lambda valid: valid + "# größer\n".encode("latin-1")),
    "twice": _text(lambda text: text * 2),
    "open quote": _text(lambda text: text.replace("\n", '\n"', 1)),
    "open triple quote": _text(lambda text: 'a = """' + text),
    "control codes": _text(lambda text: text.replace("a", "\x1b]0;x\x07a", 3)),
    "one number nan": _text(_one_cell("nan")),
    "one number 1e308": _text(_one_cell("1e308")),
    "numbers nan": _text(_cells("nan")),
    "numbers inf": _text(_cells("inf")),
    "numbers 1e308": _text(_cells("1e308")),
    "numbers -1": _text(_cells("-1")),
    "numbers 0": _text(_cells("0")),
    "numbers of 400 digits": _text(_cells("9" * 400)),
    "first line alone": _text(lambda text: text.splitlines()[0] + "\n"),
    "first two lines": _text(lambda text: "\n".join(text.splitlines()[:2]) + "\n"),
}
TOML: Mapping[str, Callable[[Path, Path], None]] = {
    "deep tables": _text(lambda text: f"{text}\n[{'.'.join('a' * 3000)}]\n"),
    "deep lists": _text(lambda text: f"zz = {'[' * 5000}{']' * 5000}\n{text}"),
    "deep inline": _text(lambda text: f"zz = {'{a=' * 5000}1{'}' * 5000}\n{text}"),
    "many keys": _text(lambda text: "".join(f"k{k} = 1\n" for k in range(150_000)) + text),
    "many tables": _text(lambda text: text + "".join(f"[[t{k}]]\n" for k in range(_MANY))),
    "strange names": _text(lambda text: '"\\u001b[31m" = 1\n"a\\nb" = 2\n' + text),
}
TABLE: Mapping[str, Callable[[Path, Path], None]] = {
    "columns twice": _text(_columns_twice),
    "lines twice": _text(_lines_twice),
    "negative ids": _text(_negative_ids),
    "no header": _text(lambda text: text.partition("\n")[2]),
    "many columns": _text(lambda text: ",".join(f"c{k}" for k in range(_MANY)) + "\n"),
    "semicolons": _text(lambda text: text.replace(",", ";") if "," in text else text.replace(";", ",")),
    "tabs": _text(lambda text: text.replace(",", "\t").replace(";", "\t")),
    "backwards": _text(
        lambda text: "\n".join([text.split("\n")[0], *text.strip().split("\n")[:0:-1]]) + "\n"
    ),
}


def kinds_for(name: str) -> Mapping[str, Callable[[Path, Path], None]]:
    """What may lie in the place of a file of that name: writers of a path, given the valid file."""
    suffix = Path(name).suffix
    out = dict(ANY)
    if suffix in _TEXT:
        out |= TEXT
    if suffix == ".toml":
        out |= TOML
    if suffix == ".csv":
        out |= TABLE
    return out


STRANGE_NAMES = ("a\x1b]0;x\x07b", "two\nlines", "-leading", "a" * 255, "größe %s{0}$HOME`id`[b]")
NUMBERS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e400", "-1", "0", "1e-300", "-0.0", "3", "1e5", "1e12"),
    *("9" * 400, "9223372036854775808", "1e5x", "", "0x10", "1_0", "٣"),
)
