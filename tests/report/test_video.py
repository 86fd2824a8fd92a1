"""The film as GIF and MP4."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from glintrack.report import Composite, write_video
from glintrack.results.figures import MARKS
from glintrack.results.read import read_result
from tests.report import made


@pytest.fixture
def result(tmp_path):
    return read_result(made.write_small_result(tmp_path / "result"))


def test_pictures_stand_side_by_side_with_tracks_where_they_are(result):
    film = Composite.of(result, ("rgb", "dolp"), width=600)
    assert len(film) == 3 and film.size == (300, 200)
    frame = film.draw(0)
    assert frame.shape == (200, 600, 3)
    blue = np.array([int(MARKS["true"][k : k + 2], 16) for k in (1, 3, 5)])
    y, x = np.nonzero((frame[:, :300] == blue).all(axis=-1))
    west, south, east, north = made.EXTENT_M
    expected = (
        (made.FIRST_X_M - west) / (east - west) * 300,
        (north - made.FIRST_Y_M) / (north - south) * 200,
    )
    one_pixel = 1.0
    assert abs(np.array([x.mean(), y.mean()]) - expected).max() < one_pixel  # track 7 coasts: another colour


@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_a_video_is_written_whole(result, tmp_path, ending):
    if ending == "mp4":
        ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra `video`")
    film = Composite.of(result, width=320)
    path = tmp_path / f"out.{ending}"
    write_video(path, map(film.draw, range(3)), film.rate_hz)
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name, "result"]
    if ending == "gif":
        with Image.open(path) as gif:
            assert gif.n_frames == 3 and gif.size == (320, 212)
            assert gif.info["duration"] == pytest.approx(1000 / film.rate_hz, abs=10)  # GIF counts in 10 ms
    else:
        assert ffmpeg.count_frames_and_secs(str(path))[0] == 3


def test_wrong_wishes_are_told(result, tmp_path):
    with pytest.raises(ValueError, match=r"must be in the film \(rgb, pan, dolp, aop\); got 'ir'"):
        Composite.of(result, ("ir",))
    film = replace(result, film=result.film | {"kinds": ["rgb", "pan"]})
    for wished in ("dolp",), ("rgb", "dolp"):
        with pytest.raises(ValueError, match=r"in the film \(rgb, pan\); got 'dolp'"):
            Composite.of(film, wished)
    assert Composite.of(film).kinds == ("rgb", "pan")
    with pytest.raises(ValueError, match="`channel` must be one of pan; got 'dolp'"):
        Composite.of(result, channel="dolp")
    with pytest.raises(ValueError, match=r"must end in .mp4 or .gif"):
        write_video(tmp_path / "out.avi", [], 1.0)
    (result.path / "film" / "film.json").unlink()
    with pytest.raises(ValueError, match="must have a film"):
        Composite.of(read_result(result.path))


@pytest.mark.parametrize(("rate_hz", "frames"), [(2.0, 6), (15.0, 60), (30.0, 60), (60.0, 60), (200.0, 61)])
def test_a_gif_lasts_as_long_as_its_frames(tmp_path, rate_hz, frames):
    """Its frames last whole hundredths of a second, and two at least."""
    pictures = [np.full((4, 4, 3), 4 * k, np.uint8) for k in range(frames)]
    write_video(tmp_path / "a.gif", pictures, rate_hz)
    with Image.open(tmp_path / "a.gif") as gif:
        shown_ms = []
        for k in range(gif.n_frames):
            gif.seek(k)
            shown_ms.append(gif.info["duration"])
    assert min(shown_ms) >= 20 and sum(shown_ms) == pytest.approx(1000 * frames / rate_hz, abs=20)
