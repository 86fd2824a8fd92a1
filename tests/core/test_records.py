"""Small records: frozen, with the defaults that stages rely on."""

from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest

from glintrack.core.records import ServedQueries, SpectralQuery

RECORDS = (
    SpectralQuery(1.0, 2.0),
    ServedQueries((), np.zeros(0, int), np.zeros(0, int), ()),
)


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: type(r).__name__)
def test_records_are_frozen(record):
    for field in fields(record):
        with pytest.raises(FrozenInstanceError):
            setattr(record, field.name, None)


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: type(r).__name__)
def test_every_field_is_described_with_its_unit_in_the_name(record):
    text = type(record).__doc__
    for field in fields(record):
        assert field.name in text


def test_query_position_is_east_north_up_in_floats():
    position = SpectralQuery(3, -4, 5).position
    assert position.dtype == float
    np.testing.assert_array_equal(position, [3.0, -4.0, 5.0])
    assert SpectralQuery(3.0, -4.0).position[2] == 0


def test_a_query_is_for_no_track_unless_said():
    assert SpectralQuery(0.0, 0.0).track_id == -1


def test_served_is_where_a_mirror_was_found():
    queries = tuple(SpectralQuery(float(i), 0.0) for i in range(3))
    served = ServedQueries(queries, np.array([4, -1, 0]), np.array([2, -1, 0]), ("", "outside the frame", ""))
    np.testing.assert_array_equal(served.is_served, [True, False, True])
