"""Damage a valid file: by bytes, and by what its format is made of. The same seed gives the same damage."""

import gzip
import random
import re
import struct

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
STRANGE = (
    *(b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e30", b"-32768", b"0", b"-1", b"1e-300", b""),
    *(
        b"9" * 400,
        b"1_000",
        b"0x10",
        b"true",
        b"oops",
        b"\x1b[31m",
        b"18446744073709551616",
        b"..",
        b"/dev/zero",
    ),
)
EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF)
MOST_BYTES = 4_000_000


def mutated(seed_file: bytes, chance: random.Random) -> bytes:
    """One damaged copy of a file."""
    if seed_file[:2] == b"\x1f\x8b" and chance.random() < 0.7:  # what is inside, too
        return gzip.compress(mutated(gzip.decompress(seed_file), chance), 1)
    out = seed_file
    for _ in range(chance.choice((1, 1, 1, 2, 3, 8))):
        text = _is_text(out)
        out = chance.choice(TEXT if text and chance.random() < 0.75 else BINARY)(out, chance)
    return out[:MOST_BYTES]


def _is_text(data: bytes) -> bool:
    return b"\x00" not in data[:4000]


def _place(data: bytes, chance: random.Random) -> int:
    return chance.randrange(len(data)) if data else 0


def flip_a_bit(data, chance):
    if not data:
        return b"\x00"
    k = _place(data, chance)
    return data[:k] + bytes([data[k] ^ (1 << chance.randrange(8))]) + data[k + 1 :]


def overwrite_an_integer(data, chance):
    width = chance.choice((1, 2, 4, 8))
    k = _place(data, chance) // width * width
    value = chance.choice(EXTREMES) & ((1 << (8 * width)) - 1)
    return data[:k] + value.to_bytes(width, chance.choice(("little", "big"))) + data[k + width :]


def overwrite_a_float(data, chance):
    value = chance.choice((float("nan"), float("inf"), 1e308, -1e30))
    k = _place(data, chance) // 4 * 4
    form = chance.choice("fd")
    raw = (
        struct.pack(f"<{form}", value) if form == "d" or abs(value) < 1e38 or value != value else b"\xff" * 4
    )
    return data[:k] + raw + data[k + len(raw) :]


def cut_short(data, chance):
    return data[: _place(data, chance)]


def leave_out(data, chance):
    k = _place(data, chance)
    return data[:k] + data[k + chance.randrange(1, 64) :]


def repeat(data, chance):
    k = _place(data, chance)
    part = data[k : k + chance.randrange(1, 200)]
    return data[:k] + part * chance.choice((2, 3, 1000)) + data[k:]


def insert_noise(data, chance):
    k = _place(data, chance)
    return data[:k] + chance.randbytes(chance.randrange(1, 16)) + data[k:]


def strange_number(data, chance):
    found = list(NUMBER.finditer(data))
    if not found:
        return insert_noise(data, chance)
    hit = chance.choice(found)
    return data[: hit.start()] + chance.choice(STRANGE) + data[hit.end() :]


def line_twice(data, chance):
    lines = data.split(b"\n")
    k = chance.randrange(len(lines))
    return b"\n".join(lines[: k + 1] + lines[k:])


def line_gone(data, chance):
    lines = data.split(b"\n")
    del lines[chance.randrange(len(lines))]
    return b"\n".join(lines)


def lines_swapped(data, chance):
    lines = data.split(b"\n")
    a, b = chance.randrange(len(lines)), chance.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def word_gone(data, chance):
    words = list(re.finditer(rb"\w+", data))
    if not words:
        return data
    hit = chance.choice(words)
    return data[: hit.start()] + data[hit.end() :]


def nest_deeply(data, chance):
    k = _place(data, chance)
    deep = chance.choice((b"[", b"{a=", b"<a>", b"((", b"[[a]]\n"))
    return data[:k] + deep * chance.choice((50, 5000)) + data[k:]


def control_codes(data, chance):
    k = _place(data, chance)
    return (
        data[:k] + chance.choice((b"\x00", b"\x1b]0;x\x07", b"\r", b"\xe2\x80\xae", b"\xff\xfe")) + data[k:]
    )


BINARY = (
    flip_a_bit,
    flip_a_bit,
    overwrite_an_integer,
    overwrite_a_float,
    cut_short,
    leave_out,
    repeat,
    insert_noise,
)
TEXT = (
    *(strange_number, strange_number, strange_number, line_twice, line_gone, lines_swapped),
    *(word_gone, nest_deeply, control_codes),
)
