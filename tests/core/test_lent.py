"""Memory that goes on to the next array, and not before nobody holds the last."""

import gc
from collections import deque

import numpy as np
import pytest

from glintrack.core import lent
from glintrack.core.lent import LEAST_BYTES, MOST_BYTES

ROWS = LEAST_BYTES // 4 // 16 + 100


@pytest.fixture(autouse=True)
def idle(monkeypatch):
    """Nothing waits yet."""
    monkeypatch.setattr(lent, "_idle", deque(maxlen=4))


def place(array):
    return array.__array_interface__["data"][0]


def test_memory_goes_on_once_nobody_holds_a_view_of_it():
    first = lent.lent(ROWS, 16)
    assert first.shape == (ROWS, 16) and first.dtype == np.float32 and not first.any()
    first[:] = 1.0
    view, there = first[10:20, ::2], place(first)
    del first
    gc.collect()
    second = lent.lent(ROWS, 16)
    assert place(second) != there and (view == 1.0).all()
    del view
    gc.collect()
    assert place(lent.lent(ROWS - 50, 16)) == there


def test_what_is_small_or_huge_takes_no_place_of_others():
    kept = lent.lent(ROWS, 16)
    there = place(kept)
    del kept
    for size in (0, 1, LEAST_BYTES // 4 - 1, MOST_BYTES // 4 + 1) * 3:
        assert lent.lent(size).shape == (size,)
    assert place(lent.lent(ROWS, 16)) == there
    for k in range(6):
        lent.lent(ROWS << min(k, 4), 16)
    assert len(lent._idle) == 4


def test_a_piece_that_was_outgrown_goes_and_others_wait():
    pieces = [lent.lent(ROWS * part, 16) for part in (1, 4)]
    held = [int(1.3 * piece.nbytes) for piece in pieces]
    del pieces
    gc.collect()
    assert sorted(memory.nbytes for memory in lent._idle) == pytest.approx(held, rel=1e-6)
    grown = lent.lent(ROWS * 6, 16)  # more than was asked for first, and than it had room for
    assert [memory.nbytes for memory in lent._idle] == pytest.approx(held[:1], rel=1e-6)
    del grown
    gc.collect()
    assert len(lent._idle) == 2
