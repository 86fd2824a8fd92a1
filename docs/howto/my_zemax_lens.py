"""Convert a sequential Zemax file to a lens of glintrack: python my_zemax_lens.py lens.zmx lens.toml

Object height fields, an object-space NA, and spherical or conic surfaces; everything else is refused by name.
"""

import re
import sys
from pathlib import Path

UNITS_MM = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
APERTURES = ("CLAP", "FLAP", "OBSC", "SQAP", "SQOB", "ELAP", "ELOB", "UDAD", "UDOB")


def read_words(text: str, key: str, default: str = "") -> list[str]:
    """Words that follow a key on its line."""
    found = re.search(rf"^\s*{key}\b(.*)$", text, re.MULTILINE)
    return (found[1] if found else default).split()


def check(is_right: bool, requirement: str) -> None:
    """End the program with what the file must have."""
    if not is_right:
        sys.exit(f"the Zemax file must have {requirement}")


def convert(text: str) -> str:
    """Text of a Zemax file as TOML."""
    head, *blocks = re.split(r"^SURF\s+\d+\s*$", text, flags=re.MULTILINE)
    unit = UNITS_MM.get((read_words(head, "UNIT") or ["none"])[0], 0.0)
    check(unit > 0, f"a UNIT of {', '.join(UNITS_MM)}")
    check(read_words(head, "MODE", "SEQ") == ["SEQ"], "sequential mode")
    check(read_words(head, "MNUM", "1")[0] == "1", "one configuration")
    counts = read_words(head, "FTYP")[:4]
    check(len(counts) == 4, "numbers of fields and wavelengths (FTYP); save it by a newer version")
    kind, telecentric, fields, waves = (int(word) for word in counts)
    check(kind == 1, "fields of the type Object Height (FTYP 1)")
    aperture = read_words(head, "OBNA")
    check(aperture[1:2] == ["0"], "an aperture of the type Object Space NA (OBNA)")
    x, y = ([unit * float(v) for v in read_words(head, key)[:fields]] for key in ("XFLN", "YFLN"))
    lines = re.findall(r"^WAVM\s+(\d+)\s+(\S+)", head, re.MULTILINE)
    lengths = sorted({float(length) for number, length in lines if int(number) <= waves})
    distance = read_words(blocks[0], "DISZ")[0]
    check(distance != "INFINITY", "an object at a finite distance (SURF 0, DISZ)")
    out = [
        f'name = "{" ".join(read_words(head, "NAME", "Zemax lens")).replace(chr(34), "")[:80]}"',
        f"object_distance_mm = {unit * float(distance):.9g}",
        f"f_number = {0.5 / float(aperture[0]):.9g}",
        f"telecentric = {str(telecentric == 1).lower()}",
        f"fields_mm = {[list(place) for place in zip(x, y, strict=True)]}",
        f"wavelengths_um = {lengths}",
    ]
    for number, block in enumerate(blocks[1:-1], start=1):  # without object and image
        form, glass = read_words(block, "TYPE")[0], (read_words(block, "GLAS") or ["air"])[0]
        check(form == "STANDARD", f"surfaces of the type STANDARD; got {form} at SURF {number}")
        check(not glass.startswith("___"), f"glasses of a catalogue; got a model glass at SURF {number}")
        shut = [key for key in APERTURES if read_words(block, key)]
        check(not shut, f"no apertures other than the stop; got {shut} at SURF {number}")
        curvature, thickness = float(read_words(block, "CURV")[0]), read_words(block, "DISZ")[0]
        check(thickness != "INFINITY", f"a finite thickness at SURF {number}")
        out += ["", "[[surfaces]]"]
        out += [f"radius_mm = {unit / curvature:.9g}"] if curvature else []
        out += [f"thickness_mm = {unit * float(thickness):.9g}"]
        out += [f'material = "{"mirror" if glass.upper() == "MIRROR" else glass}"']
        out += [f"conic = {float(read_words(block, 'CONI', '0')[0]):.9g}"]
        out += ["stop = true"] * bool(re.search(r"^\s*STOP\b", block, re.MULTILINE))
    return "\n".join(out)


if __name__ == "__main__":
    content = Path(sys.argv[1]).read_bytes()
    wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    Path(sys.argv[2]).write_text(convert(content.decode("utf-16" if wide else "latin-1")), "utf-8")
