"""A set of three cars: its layers agree with each other, it resumes, the same seeds give the same bytes."""

import io
import json
import shutil
from contextlib import redirect_stdout

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from glintrack.case import build as scenario
from glintrack.case.build import build_scenario
from glintrack.dataset import (
    BASELINES,
    TrackingSet,
    build,
    build_dataset,
    plan_dataset,
    score_baselines,
    simulate_frames,
    split_by_city,
    standard_cases,
)
from glintrack.dataset.build import read_plan
from glintrack.dataset.plan import city_of
from glintrack.io.atomic import content_hash
from glintrack.io.raw_mosaics import read_raw
from glintrack.scene import load_materials
from glintrack.sensor import RawDesign, measure_polarization
from tests.conftest import ThreeCars
from tests.plain import plain_case

FRAMES, SHARD = 5, 2


def case(name="three", **changes):
    design = {
        "name": name,
        "seed": 4,
        "channels": ["pan"],
        "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": FRAMES, "rate_hz": 2.0},
        "sensor": {"rows": 240, "columns": 320},
        "navigation": {"position_rms_m": 0.2},
    }
    return plain_case({**design, **changes})


@pytest.fixture(scope="module")
def plan():
    return plan_dataset([case()], shard_frames=SHARD)


@pytest.fixture(scope="module")
def built(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenario, "build_scene", lambda design: ThreeCars(load_materials()))
        assert build_dataset(plan, folder) == FRAMES
    return folder


def bytes_of(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def data(folder, number):
    with xr.open_dataset(folder / "shards" / f"three-{number:03d}.nc", engine="h5netcdf") as opened:
        return opened.load()


def test_a_set_holds_what_it_says_and_its_layers_agree(built, plan):
    assert sorted(p.name for p in (built / "raw" / "three").iterdir()) == [
        f"{k:06d}.png" for k in range(1, 6)
    ]
    sums = dict(line.split("  ")[::-1] for line in (built / "SHA256SUMS").read_text().splitlines())
    files = bytes_of(built)
    assert set(sums) == set(files) - {"SHA256SUMS"}
    assert all(content_hash(files[name]) == found for name, found in sums.items())
    shard = data(built, 1)
    assert shard["frame"].values.tolist() == [2, 3] and shard["time_s"].values.tolist() == [1.0, 1.5]
    boxes = pd.read_csv(built / "shards" / "three-001.boxes.csv")
    assert set(boxes["vehicle_id"]) == {11, 22, 33} and (boxes["speed_m_s"] == 9.0).all()
    for row in boxes[boxes["frame"] == 2].to_dict("records"):
        y, x = np.nonzero(shard["mask"].values[0] == row["vehicle_id"])
        assert row["x0_px"] <= x.min() and x.max() <= row["x1_px"]
        assert row["y0_px"] <= y.min() and y.max() <= row["y1_px"]
        assert (
            row["x1_px"] - row["x0_px"] - np.ptp(x) < 2.0
        )  # a box ends within an element of the last middle
    truth = pd.read_csv(built / "shards" / "three-001.truth.csv")
    np.testing.assert_allclose(truth["east_m"][truth["vehicle_id"] == 11], [-71.0, -66.5])
    at = shard.sel(frame=2)
    assert abs(float(at["true_pose"][0]) - float(at["reported_pose"][0])) > 1e-3
    assert "| train | 1 |" in (built / "datasheet.md").read_text()


def test_a_raw_gives_the_light_but_for_noise_and_blur(built):
    """Its S0 on the even ground, by the product's own reader, is the light's up to one gain."""
    raw = read_raw(built / "raw" / "three" / "000001.png")
    seen = measure_polarization(raw, RawDesign(layout="mirror-0-60-120"))["stokes_radiance"].values
    light = data(built, 0)["light"].values[0]
    far = data(built, 0)["mask"].values[0].reshape(120, 2, 160, 2).max(axis=(1, 3)) < 0
    gain = np.median(seen[far][:, 0]) / np.median(light[far][:, 0])
    ground = far & (np.abs(light[..., 0] / np.median(light[..., 0]) - 1) < 0.2)
    for component in range(3):
        mean = seen[ground][:, component].mean() / gain
        a_hundredth_of_s0 = 0.01 * float(light[ground][:, 0].mean())
        assert mean == pytest.approx(light[ground][:, component].mean(), abs=a_hundredth_of_s0)


def test_a_stopped_build_resumes_to_the_same_bytes(built, plan, three_cars, tmp_path):
    whole = bytes_of(built)
    again = tmp_path / "again"

    class Stopped(Exception):
        """Somebody pulls the plug."""

    def stop(shard, flown):
        if flown == 3:
            raise Stopped

    with pytest.raises(Stopped):
        build_dataset(plan, again, stop)
    assert not (again / "SHA256SUMS").exists()
    assert build_dataset(plan, again) == FRAMES - SHARD
    assert bytes_of(again) == whole
    (again / "raw" / "three" / "000005.png").write_bytes(b"damaged")
    assert build_dataset(plan, again) == 1
    assert bytes_of(again) == whole
    with pytest.raises(ValueError, match="same cases, files and program"):
        build_dataset(plan_dataset([case(seed=5)], shard_frames=SHARD), again)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").touch()
    with pytest.raises(ValueError, match="must be a new or empty folder"):
        build_dataset(plan, tmp_path / "other")


def test_a_frame_is_the_same_whatever_is_flown_beside_it(three_cars):
    alone = next(simulate_frames(case(), build_scenario(case()), [3]))
    among = list(simulate_frames(case(), build_scenario(case()), range(4)))[3]
    np.testing.assert_array_equal(alone.raw, among.raw)
    np.testing.assert_array_equal(alone.image["pan"], among.image["pan"])
    assert alone.reported_pose == among.reported_pose


def test_coco_and_mot_are_what_their_readers_take(built):
    from pycocotools.coco import COCO

    with redirect_stdout(io.StringIO()):
        coco = COCO(str(built / "coco" / "train.json"))
    assert len(coco.imgs) == FRAMES and not (built / "coco" / "test.json").exists()
    of_first = coco.loadAnns(coco.getAnnIds(imgIds=[1]))
    mask = data(built, 0)["mask"].values[0]
    assert {a["track_id"] for a in of_first} == set(np.unique(mask)) - {-1}
    for annotation in of_first:
        np.testing.assert_array_equal(coco.annToMask(annotation) > 0, mask == annotation["track_id"])
        x, y, w, h = annotation["bbox"]
        ys, xs = np.nonzero(mask == annotation["track_id"])
        assert x <= xs.min() + 0.5 and xs.max() + 0.5 <= x + w
        assert y <= ys.min() + 0.5 and ys.max() + 0.5 <= y + h
        assert annotation["area"] == len(xs)
    assert (
        json.loads((built / "coco" / "train.json").read_text())["images"][4]["file_name"]
        == "raw/three/000005.png"
    )
    rows = np.loadtxt(built / "mot" / "train" / "three" / "gt" / "gt.txt", delimiter=",", ndmin=2)
    assert set(rows[:, 0]) == set(range(1, FRAMES + 1)) and set(rows[:, 1]) == {12, 23, 34}
    assert (rows[:, 6] == 1).all() and (rows[:, 7] == 3).all()
    info = (built / "mot" / "train" / "three" / "seqinfo.ini").read_text()
    assert "seqLength=5" in info and (built / "mot" / "train" / "three" / "../../../raw/three").is_dir()


def test_baselines_track_the_three(three_cars, tmp_path):
    """Enough frames to confirm a track; white cars on asphalt are found by ours and by a classical one."""
    plan = plan_dataset([case(flight={**case().flight.model_dump(), "frames": 14}, navigation={})])
    build_dataset(plan, tmp_path / "set")
    lines = {k: BASELINES[k] for k in ("ours, raw mosaic, pan", "ours, rectified, median motion, pan")}
    found = score_baselines(tmp_path / "set", "train", lines)
    assert list(found) == list(lines)
    assert all(scores["completeness"] > 0.3 and scores["purity"] > 0.9 for scores in found.values()), found
    with pytest.raises(ValueError, match=r"`split` must be one that the set has \(train\); got 'test'"):
        score_baselines(tmp_path / "set")
    with pytest.raises(ValueError, match="`DATASET` must be a folder that"):
        score_baselines(tmp_path)


def test_sets_satisfy_maites_protocols(built):
    protocols = pytest.importorskip(
        "maite.protocols.multiobject_tracking", reason="the dev extra's protocols"
    )
    videos = TrackingSet(built, "train")
    assert isinstance(videos, protocols.Dataset) and len(videos) == 1 and videos.metadata["id"]
    stream, target, metadata = videos[0]
    frames = list(stream)
    assert all(isinstance(frame, protocols.VideoFrame) for frame in frames)
    assert [frame.time_s for frame in frames] == [0, 0.5, 1, 1.5, 2] and frames[0].pixels.shape == (
        1,
        240,
        320,
    )
    assert metadata["height"] == 240 and len(target.frame_tracks) == FRAMES
    assert all(isinstance(one, protocols.SingleFrameObjectTrackingTarget) for one in target.frame_tracks)
    first = target.frame_tracks[0]
    assert first.boxes.shape == (3, 4) and set(first.track_ids) == {11, 22, 33} and len(first.labels) == 3
    with pytest.raises(ValueError, match=r"`split` must be one that the set has \(train\)"):
        TrackingSet(built, "val")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("shard_frames = 2\n", "must name its cases"),
        ("[cases.three]\nsplit = 'train'\n", "must have shard_frames of 1 to 1000; got None"),
        ("shard_frames = 2\n[cases.three]\nsplit = 'mine'\n", "must have cases of a split"),
        ("shard_frames = 2\n[cases.'../three']\nsplit = 'train'\n", "must have cases of a split"),
    ],
)
def test_a_set_that_says_nonsense_is_one_sentence(tmp_path, text, message):
    (tmp_path / "dataset.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_plan(tmp_path)


def test_a_set_with_a_missing_file_is_not_whole(built, tmp_path):
    again = tmp_path / "again"
    shutil.copytree(built, again)
    assert list(read_plan(again).cases) == ["three"]
    (again / "raw" / "three" / "000003.png").unlink()
    with pytest.raises(
        ValueError, match=r"must be whole and of this version; got .* without shard three-001"
    ):
        read_plan(again)


def test_a_set_whose_case_has_files_of_its_own_is_read_where_they_are_allowed(built, tmp_path):
    again = tmp_path / "again"
    shutil.copytree(built, again)
    path = again / "cases" / "three.toml"
    text = path.read_text(encoding="utf-8")
    named = text.replace('reference_spectrum = "flat"', f'reference_spectrum = "{tmp_path}/light.csv"')
    assert named != text
    path.write_text(named, encoding="utf-8")
    with pytest.raises(ValueError, match=r"must name a file in the case's folder.*allow-outside-paths"):
        read_plan(again)
    with pytest.raises(ValueError, match="must be whole and of this version"):  # it is another case now
        read_plan(again, allow_outside_paths=True)


# --- plans -----------------------------------------------------------------------------------------


def test_the_standard_set_leaks_no_city():
    cases = {one.name: one for one in standard_cases()}
    split = split_by_city(cases)
    assert len(cases) == 48 and len({one.seed for one in cases.values()}) == 48
    held = {s: {city_of(cases[n]) for n in cases if split[n] == s} for s in ("train", "val", "test")}
    assert [len(held[s]) for s in held] == [2, 1, 1]
    assert (
        not held["train"] & held["val"]
        and not held["train"] & held["test"]
        and not held["val"] & held["test"]
    )
    angles = {(one.flight.off_nadir_deg, one.atmosphere.aerosol) for one in cases.values()}
    assert len(angles) == 6
    slant = {
        round(one.flight.altitude_m / np.cos(np.radians(one.flight.off_nadir_deg)), -1)
        for one in cases.values()
    }
    assert slant == {3000.0}


def test_a_part_of_the_standard_set_keeps_its_splits():
    part = plan_dataset(["standard/*-50-clear"], frames=16)
    assert len(part.cases) == 8 and part.frames == 128
    whole = split_by_city({one.name: one for one in standard_cases()})
    assert part.split == {name: whole[name] for name in part.cases}
    assert set(plan_dataset(["standard/wildau-*"]).split.values()) == {"test"}
    assert set(plan_dataset(["standard/embedded-2-*"]).split.values()) == {"train"}
    with pytest.raises(ValueError, match=r"`CASE` must match a case of the standard set, .* got 'standard/b"):
        plan_dataset(["standard/berlin"])


def test_windows_of_one_network_are_one_city():
    def net(name, **scene):
        return case(name, scene={"city": "net", "net_file": "sumo:tools/game/DRT/osm.net.xml", **scene})

    cases = {
        "a": net("a"),
        "b": net("b", centre_m=(900.0, 900.0)),
        "c": case("c"),
        "d": case("d", scene={"seed": 9}),
    }
    assert city_of(cases["a"]) == city_of(cases["b"]) and city_of(cases["c"]) == city_of(cases["d"])
    assert split_by_city(cases) == {"a": "train", "b": "train", "c": "test", "d": "test"}


@pytest.mark.parametrize(
    ("cases", "options", "message"),
    [
        ([case(), case()], {}, "`CASE` must be named once each; got 'three' twice"),
        ([], {}, "`CASE` must be named once each; got none"),
        (
            [case(sensor={"auto_exposure": {"quantile": 0.9}})],
            {},
            "`sensor.auto_exposure.quantile` must be 0",
        ),
        ([case(sensor={"bits": 20})], {}, "`sensor.bits` must be at most 16"),
        ([case()], {"shard_frames": 0}, "`shard-frames` must lie within"),
        ([case()], {"frames": 0}, "`frames` must lie within"),
    ],
)
def test_a_wrong_plan_is_one_sentence(cases, options, message):
    with pytest.raises(ValueError, match=message):
        plan_dataset(cases, **options)


def test_a_set_is_not_resumed_with_other_files_or_another_program(plan, built, monkeypatch, tmp_path):
    again = tmp_path / "again"
    shutil.copytree(built, again)
    assert build_dataset(plan, again) == 0  # whole already
    monkeypatch.setattr(build, "case_key", lambda case: "of another source")
    with pytest.raises(ValueError, match="of the same cases, files and program"):
        build_dataset(plan, again)
