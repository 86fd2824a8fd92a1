"""A recording comes back from its file as it went in."""

from importlib import resources

import numpy as np
import pytest

from glintrack.scene.objects.surfaces import Lane, RoadNetwork
from glintrack.scene.traffic import Recording, Traffic, read_recording, write_recording

HALF_A_MILLIMETRE = 0.0005 + 1e-9  # coordinates are stored in whole millimetres


@pytest.fixture
def recording():
    rng = np.random.default_rng(4)
    count = np.array([7, 1, 12])
    lanes = (
        Lane("e", 0, "walk", np.array([[0, 0.1], [5, 5.0], [9, 9]]), 2.0),
        Lane("e", 1, "car", np.array([[0, 3.0], [9, 12.0]]), 3.2, True, "highway.residential"),
    )
    traffic = Traffic(
        0.1,
        20,
        np.array([0, 4, 8]),
        count,
        np.array([0, 3, 1]),
        rng.uniform(-350, 350, 20),
        rng.uniform(-350, 350, 20),
        rng.uniform(0, 6.28, 20),
    )
    return Recording(RoadNetwork(lanes, (np.array([[0, 0], [1, 0], [1, 1.0]]),)), traffic)


def test_round_trip(tmp_path, recording):
    path = tmp_path / "r.nc"
    write_recording(path, recording, {"title": "t", "source": "s", "licence": "l"})
    back = read_recording(path)
    for name in ("first", "count", "model"):
        np.testing.assert_array_equal(getattr(back.traffic, name), getattr(recording.traffic, name))
    for name in ("bumper_east", "bumper_north"):
        np.testing.assert_allclose(
            getattr(back.traffic, name), getattr(recording.traffic, name), atol=HALF_A_MILLIMETRE
        )
    turn = np.angle(np.exp(1j * (back.traffic.angle - recording.traffic.angle)))
    assert np.abs(turn).max() <= 0.5e-4 + 1e-12  # headings are stored in 0.1 mrad
    for a, b in zip(back.network.lanes, recording.network.lanes, strict=True):
        assert (a.edge_id, a.index, a.kind, a.signalled, a.street_type) == (
            b.edge_id,
            b.index,
            b.kind,
            b.signalled,
            b.street_type,
        )
        np.testing.assert_allclose(a.points, b.points, atol=HALF_A_MILLIMETRE)
    np.testing.assert_allclose(back.network.junctions[0], recording.network.junctions[0])


@pytest.mark.parametrize("cut", [0, 100, 3000])
def test_damaged_file_is_refused(tmp_path, recording, cut):
    path = tmp_path / "r.nc"
    write_recording(path, recording, {"title": "t"})
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"`r.nc` must be a whole recording"):
        read_recording(path)


def test_shipped_recording_names_its_source_and_is_small():
    import h5netcdf

    path = resources.files("glintrack") / "data" / "traffic" / "embedded.nc"
    with h5netcdf.File(str(path), "r") as file:
        for name in ("title", "source", "licence", "units"):
            assert file.attrs[name]
        assert "record_embedded_traffic.py" in file.attrs["source"]
    assert len(path.read_bytes()) < 1.5e6
