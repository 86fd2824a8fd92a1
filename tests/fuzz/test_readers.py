"""Damaged files are refused, or read as finite values; FUZZ_FILES=10000 in the environment tries more."""

import os
import random
import warnings

import pytest

from tests.fuzz.judge import judged
from tests.fuzz.mutations import mutated
from tests.fuzz.readers import READERS

FILES = int(os.environ.get("FUZZ_FILES", "25"))  # a reader
every_reader = pytest.mark.parametrize("reader", READERS, ids=[r.name for r in READERS])


@every_reader
def test_the_valid_file_is_read(reader, tmp_path):
    path = tmp_path / f"valid{reader.suffix}"
    reader.write(path)
    assert judged(reader, path) == "read"


@every_reader
def test_damaged_files_are_refused_or_read_whole(reader, tmp_path):
    path = tmp_path / f"valid{reader.suffix}"
    reader.write(path)
    valid = path.read_bytes()
    verdicts = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for k in range(FILES):
            path.write_bytes(mutated(valid, random.Random(f"test {reader.name} {k}")))
            verdicts.append((k, judged(reader, path)))
    assert [v for v in verdicts if v[1] not in ("read", "refused")] == []
