"""Frames of one's own: which files of a folder, in which order, and what they need."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from glintrack.io.images import write_frame
from glintrack.io.orthoimages import Geotransform, image_of, leave_out_repeated, open_frames
from glintrack.io.readings import collect_readings
from glintrack.io.untrusted import sort_by_number

HERE = Geotransform(0.0, 0.0, 1.0)


def write(folder, name, level, alpha=False, world=None):
    values = np.full((6, 8), level, np.uint8)
    image = Image.merge("LA", [Image.fromarray(v) for v in (values, values // 2)]) if alpha else None
    (image or Image.fromarray(values)).save(folder / name)
    if world is not None:
        (folder / name).with_suffix(world).write_text("0.5\n0\n0\n-0.5\n1000.25\n1999.75\n")


def levels(source):
    return [float(image["pan"].values.mean()) for _, image in source.frames]


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp"])
def test_pictures_are_frames_in_the_order_of_their_numbers(tmp_path, suffix):
    for k in (1, 2, 10):
        write(tmp_path, f"frame{k}.{suffix}", 20 * k)
    assert levels(open_frames(tmp_path, 1.25, HERE)) == pytest.approx([20, 40, 200], abs=1)


def video(path, pictures, times_s, *options):
    """Write pictures at their times, each a grey level."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra `video`")
    lines = []
    for k, (level, time_s) in enumerate(zip(pictures, times_s, strict=True)):
        Image.fromarray(np.full((48, 64), level, np.uint8)).save(path.with_suffix(f".{k}.png"))
        long_s = times_s[k + 1] - time_s if k + 1 < len(times_s) else 0.1
        lines.append(f"file '{path.with_suffix(f'.{k}.png')}'\nduration {long_s:.3f}")
    path.with_suffix(".txt").write_text("\n".join(lines))
    words = (
        "-y -loglevel error -f concat -safe 0 -i {} -fps_mode vfr -enc_time_base 1/1000 -c:v libx264 -qp 1"
    )
    command = words.format(path.with_suffix(".txt")).split()
    subprocess.run([ffmpeg.get_ffmpeg_exe(), *command, "-pix_fmt", "yuv420p", str(path)], check=True)


def test_pictures_of_a_video_have_their_own_times(tmp_path):
    """At gaps that vary, each once; with a rate all of them, one after the other."""
    times_s, levels = [0.0, 0.12, 0.6, 1.0, 1.52, 1.6, 2.2], [40, 60, 80, 100, 120, 140, 160]
    video(tmp_path / "v.mp4", levels, times_s)
    frames = [
        (t, float(image["pan"].mean())) for t, image in open_frames(tmp_path / "v.mp4", None, HERE).frames
    ]
    np.testing.assert_allclose([t for t, _ in frames], times_s, atol=0.011)
    np.testing.assert_allclose([level for _, level in frames], levels, atol=2)
    at_rate = open_frames(tmp_path / "v.mp4", 5.0, HERE).frames
    np.testing.assert_allclose([t for t, _ in at_rate], 0.2 * np.arange(7))


def test_frames_named_by_seconds_are_in_the_order_of_time(tmp_path):
    for k, name in enumerate(("0.0", "0.25", "0.5", "0.75", "1.0")):
        write(tmp_path, f"{name}.png", 20 * k)
    assert levels(open_frames(tmp_path, 4.0, HERE)) == [0, 20, 40, 60, 80]
    for names in (
        ["0.9.png", "10.25.png", "1403636579763555584.png", "1403636579763555585.png"],
        ["cam1.3.png", "cam1.20.png", "f_1.05.tif", "f_1.25.tif", "f_10.25.tif", "v2.jp2", "v10.jp2"],
    ):
        paths = [Path(name) for name in names]
        assert sort_by_number(paths[::-1], "frames") == paths
    with pytest.raises(ValueError, match=r"`frames` must have names in one order; got names such as f_1"):
        sort_by_number([Path("f_1.5.tif"), Path("f_1.25.tif")], "frames")


def test_frames_that_repeat_are_left_out_and_told(tmp_path):
    """As of a video that repeats each picture of a slower camera: in its second a vehicle would stand."""
    for k, level in enumerate((20, 20, 90, 90, 20)):
        write(tmp_path, f"{k}.png", level)
    source = leave_out_repeated(open_frames(tmp_path, 2.0, HERE), tmp_path)
    with collect_readings() as read:
        frames = [(t, float(image["pan"].mean())) for t, image in source.frames]
    assert frames == [(0.0, 20.0), (1.0, 90.0), (2.0, 20.0)] and source.times_s == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert (read[-1].found, read[-1].used, read[-1].left_out) == (5, 3, (("equal to the frame before", 2),))


def test_a_world_file_says_where(tmp_path):
    write(tmp_path, "a.png", 7, world=".pgw")
    ((_, image),) = open_frames(tmp_path, 1.0).frames
    assert image["x"].values[:2] == pytest.approx([1000.25, 1000.75])
    assert image["y"].values[0] == pytest.approx(1999.75)


def test_a_geotransform_over_the_frames_own_is_told(tmp_path):
    write(tmp_path, "a.png", 7, world=".pgw")
    with pytest.warns(UserWarning, match="--geotransform replaces the position"):
        ((_, image),) = open_frames(tmp_path, 1.0, HERE).frames
    assert image["x"].values[0] != pytest.approx(1000.25)


def test_without_place_one_sentence_says_what_to_give(tmp_path):
    write(tmp_path, "a.png", 7)
    with pytest.raises(ValueError, match=r"world file; got none in .*--geotransform"):
        open_frames(tmp_path, 1.0)


def test_a_frame_of_a_run_is_read_back_with_its_polarization(tmp_path):
    light = np.random.default_rng(1).uniform(1.0, 2.0, (6, 8, 3)).astype(np.float32)
    bands = dict(zip("IQU", np.moveaxis(light * (1.0, 0.2, 0.1), -1, 0), strict=True))
    image = image_of(bands, HERE)
    np.testing.assert_array_equal(image["pan"], bands["I"])  # not the mean of I, Q and U
    image = image.assign(pan=0.9 * image["pan"]).assign_attrs(gsd_m=1.0)
    write_frame(tmp_path / "pan_0001.00s.tif", image, "EPSG:32618", (300000.0, 4800000.0))
    ((_, found),) = open_frames(tmp_path, 1.0).frames
    for name in ("pan", "dolp", "stokes_radiance"):
        np.testing.assert_allclose(found[name], image[name], rtol=1e-5)


def test_transparency_is_no_light(tmp_path):
    write(tmp_path, "a.png", 200, alpha=True)
    assert levels(open_frames(tmp_path, 1.0, HERE)) == [200]


def test_previews_beside_geotiffs_are_not_frames(tmp_path):
    write(tmp_path, "a.tif", 7)
    write(tmp_path, "a.png", 9)
    assert levels(open_frames(tmp_path, 1.0, HERE)) == [7]


def test_a_folder_without_rasters_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a folder with rasters \(.tif .* .png"):
        open_frames(tmp_path)
