"""Running a study: the same table from every executor, and what survives when things break."""

import errno
import json
import math
import multiprocessing
import os
import signal
import subprocess
import time
from pathlib import Path

import pandas as pd
import pytest
import xarray as xr

from glintrack.case.design import Case
from glintrack.case.identity import source_key
from glintrack.case.packaged import find_case
from glintrack.study import (
    StudyFolder,
    StudyPace,
    analyse,
    dask,
    estimate_cpu_s,
    processes,
    read_plan,
    read_results,
    run_study,
    serial,
    write_results,
)
from tests.study.cases import KILLS, KILLS_ONCE, RAISES, SLOW, TWELVE, cheap, flown, write_study


def fly(tmp_path, text=TWELVE, pool=None, name="out", fly_one=cheap):
    """Run a study of cheap cases; its report, its table and its folder."""
    plan = read_plan(write_study(tmp_path, text))
    folder, scratch = StudyFolder(tmp_path / name), tmp_path / f"scratch-{name}"
    scratch.mkdir(exist_ok=True)
    with folder.open(plan), pool or serial() as workers:
        report = run_study(plan, folder, workers, scratch, fly_one)
        table = write_results(plan, folder)
    return report, table, folder


def test_what_is_finished_is_not_flown_again(tmp_path):
    fly(tmp_path)
    report, table, _ = fly(tmp_path)
    assert (report.finished_before, report.finished, flown(tmp_path / "scratch-out")) == (12, 0, 12)
    assert set(table["status"]) == {"finished"}


def test_the_first_replicates_are_reported_as_if_there_were_no_others_and_the_rest_follow(tmp_path):
    plan = read_plan(write_study(tmp_path, TWELVE))
    folder, scratch = StudyFolder(tmp_path / "out"), tmp_path / "scratch-out"
    scratch.mkdir()
    with folder.open(plan), serial() as workers:
        assert run_study(plan.first(1), folder, workers, scratch, cheap).finished == 6
        table = write_results(plan, folder)
    assert table["status"].value_counts().to_dict() == {"finished": 12, "missing": 12}
    _, alone, lonely = fly(tmp_path / "alone", TWELVE.replace("[1, 2]", "[1]"))
    expected = analyse(alone, read_results(lonely.path)[1])
    for name, part in analyse(table, read_results(folder.path)[1]).items():
        pd.testing.assert_frame_equal(part, expected[name])
    report, table, _ = fly(tmp_path)
    assert (report.finished_before, report.finished) == (6, 6) and set(table["status"]) == {"finished"}


def test_listed_cases_have_their_labels_in_the_table(tmp_path):
    text = 'design = "list"\ncases = [{label = "coarse", sensor.pitch_um = 17}, {sensor.pitch_um = 8.5}]\n'
    _, table, folder = fly(tmp_path, text)
    assert list(table["label"]) == ["coarse", "coarse", "1", "1"] and table["case"].nunique() == 2
    with xr.open_dataset(folder.path / "results.nc", engine="h5netcdf") as dataset:
        assert list(dataset["label"].values) == ["coarse", "1"]
        assert float(dataset["completeness"].sel(point=1, channel="dolp")) == pytest.approx(0.93)


def test_cases_of_one_content_fly_once(tmp_path):
    text = "[axes]\nsensor.pitch_um = [17, 8.5]\ntwin = [{label = 'a', seed = 1}, {label = 'b', seed = 1}]\n"
    report, table, _ = fly(tmp_path, text)
    assert report.finished == 2 and len(table) == 6


def test_a_torn_case_is_flown_again(tmp_path):
    _, expected, folder = fly(tmp_path)
    torn = sorted((folder.path / "cases").iterdir())[3]
    (torn / "scores.json").write_text((torn / "scores.json").read_text()[:40])
    other = sorted((folder.path / "cases").iterdir())[5]
    (other / "note.txt").write_bytes(b"flo")
    report, table, _ = fly(tmp_path)
    assert report.finished == 2
    pd.testing.assert_frame_equal(table, expected)


def study_with(noise):
    return f"retries = 1\n[axes]\nsensor.read_noise_e = [20, {noise}, 21, 22]\n"


def test_a_case_that_raises_is_retried_told_and_left_behind(tmp_path):
    report, table, folder = fly(tmp_path, study_with(RAISES))
    assert report.finished == 3 and len(report.failed) == 1
    failed = folder.path / "failed" / report.failed[0]
    assert sorted(p.name for p in failed.iterdir()) == ["attempt-1.txt", "attempt-2.txt", "case.toml"]
    assert "the optics fell off" in (failed / "attempt-2.txt").read_text()
    assert "Traceback" in (failed / "attempt-2.txt").read_text()
    status = table.set_index("point")["status"]
    assert list(status.groupby(level=0).first()) == ["finished", "failed", "finished", "finished"]


@pytest.mark.slow
def test_a_killed_worker_costs_one_attempt_and_a_case_that_kills_all_fails_alone(tmp_path):
    text = f"retries = 1\n[axes]\nsensor.read_noise_e = [20, {KILLS_ONCE}, {KILLS}, 22]\n"
    report, table, folder = fly(tmp_path, text, pool=processes(2))
    assert report.finished == 3 and len(report.failed) == 1
    status = table.set_index("point")["status"].groupby(level=0).first()
    assert list(status) == ["finished", "finished", "failed", "finished"]
    assert "worker" in (folder.path / "failed" / report.failed[0] / "attempt-1.txt").read_text()


@pytest.mark.slow
def test_a_dask_worker_killed_in_a_case_is_replaced(tmp_path):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    report, table, _ = fly(tmp_path, study_with(KILLS_ONCE), pool=dask("local", 1))
    assert report.finished == 4 and not report.failed
    assert set(table["status"]) == {"finished"}


def children(pid):
    """Processes that one has started, where the system tells."""
    told = Path(f"/proc/{pid}/task/{pid}/children")
    return told.read_text().split() if told.exists() else []


def is_alive(pid):
    """Whether a process runs; one that has ended and nobody has asked about yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def drive(tmp_path):
    """A driver of its own process, to be killed."""
    slow = f"[axes]\nsensor.dsnu_e = [0, 1, 2, 3, 4, 5, 6, 7]\n[base]\nsensor.read_noise_e = {SLOW}\n"
    fly(tmp_path, slow, pool=processes(1))


@pytest.mark.slow
def test_a_killed_driver_is_resumed_and_repeats_nothing(tmp_path):
    driver = multiprocessing.get_context("spawn").Process(target=drive, args=(tmp_path,))
    driver.start()
    cases, deadline = tmp_path / "out" / "cases", time.monotonic() + 120
    while len(list(cases.glob("[0-9a-f]*"))) < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    workers = children(driver.pid)
    os.kill(driver.pid, signal.SIGKILL)
    driver.join()
    while any(is_alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(is_alive(pid) for pid in workers)  # they end with their driver
    whole = len(list(cases.glob("[0-9a-f]*")))
    assert 3 <= whole < 8
    text = f"[axes]\nsensor.dsnu_e = [0, 1, 2, 3, 4, 5, 6, 7]\n[base]\nsensor.read_noise_e = {SLOW}\n"
    report, table, _ = fly(tmp_path, text)
    assert (report.finished_before, report.finished) == (whole, 8 - whole)
    assert set(table["status"]) == {"finished"}
    assert not list(cases.glob(".*"))


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 kB; skipped where this user may not mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a tmpfs")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def bulky(case, task):
    """A cheap case that leaves 12 kB."""
    return {**cheap(case, task), "files": {"note.txt": bytes(12_000)}}


def check_full_disk(tmp_path, out):
    plan = read_plan(write_study(tmp_path, TWELVE))
    folder = StudyFolder(out)
    with folder.open(plan), serial() as pool, pytest.raises(ValueError, match="No space left") as caught:
        run_study(plan, folder, pool, tmp_path, bulky)
    assert "Finished cases are saved" in str(caught.value)
    done = [key for key in plan.cases if folder.outcome(key)]
    assert 1 <= len(done) < 12
    assert not list((out / "cases").glob(".*"))
    for key in done:
        assert json.loads((out / "cases" / key / "scores.json").read_text())["scores"]["pan"]


def test_a_full_disk_is_told_and_leaves_what_is_finished(tmp_path, small_disk):
    check_full_disk(tmp_path, small_disk / "out")


def test_a_write_without_room_is_told_and_leaves_what_is_finished(tmp_path, monkeypatch):
    """The same where nothing can be mounted: the fourth case meets ENOSPC as it is written to the disk."""
    synced, whole = [], os.fsync

    def fsync(handle):
        synced.append(handle)
        if len(synced) > 10:
            raise OSError(errno.ENOSPC, "No space left on device")
        whole(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    check_full_disk(tmp_path, tmp_path / "out")


def test_another_studys_folder_is_refused(tmp_path):
    fly(tmp_path)
    with pytest.raises(ValueError, match="of another study, 'study'"):
        fly(tmp_path, TWELVE.replace("8.5", "8.6"))


@pytest.mark.parametrize(
    ("change", "complaint"), [({"format": 99}, "of format 99"), ({"glintrack": "99.0"}, "of glintrack 99.0")]
)
def test_a_newer_folder_is_refused(tmp_path, change, complaint):
    _, _, folder = fly(tmp_path)
    head = folder.path / "study.json"
    head.write_text(json.dumps({**json.loads(head.read_text()), **change}))
    with pytest.raises(ValueError, match=complaint):
        fly(tmp_path)


def test_results_of_other_source_are_never_mixed(tmp_path, monkeypatch):
    """The version stays 0.1.0 while the source is edited; what was flown before the edit stays readable."""
    _, table, folder = fly(tmp_path)
    for module in ("case.identity", "study.folder", "study.run", "study.workers"):
        monkeypatch.setattr(f"glintrack.{module}.source_key", lambda: "edited")
    with pytest.raises(ValueError, match=r"of other source of "):
        fly(tmp_path)
    pd.testing.assert_frame_equal(read_results(folder.path)[0], table)
    report, again, _ = fly(tmp_path, name="new")
    assert report.finished == 12 and not set(again["case"]) & set(table["case"])


def test_a_worker_with_other_source_flies_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("glintrack.study.workers.source_key", lambda: "of another installation")
    report, _, folder = fly(tmp_path, "retries = 0\n[axes]\nsensor.dsnu_e = [0, 1]\n")
    assert len(report.failed) == 2 and flown(tmp_path / "scratch-out") == 0
    assert "must have workers with the driver's source" in folder.failure(report.failed[0])


def test_the_source_that_counts_is_what_decides_scores(tmp_path, monkeypatch):
    for name in ("cli/x.py", "study/report.py", "render/trace.py", "study/workers.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1")
    monkeypatch.setattr("glintrack.case.identity._PACKAGE", tmp_path)

    def key():
        source_key.cache_clear()
        return source_key()

    try:
        before = key()
        for name in ("cli/x.py", "study/report.py"):
            (tmp_path / name).write_text("2")
            assert key() == before
        for name in ("render/trace.py", "study/workers.py"):
            (tmp_path / name).write_text("2")
            assert key() != before
            before = key()
    finally:
        source_key.cache_clear()


def test_a_cluster_that_grows_and_shrinks_is_counted_anew(tmp_path, monkeypatch):
    """Jobs of a queue come and go: with none the study waits, and says so."""
    monkeypatch.setattr("glintrack.study.run._POLL_S", 0.01)
    counts, told = iter([2, 0, 0, 1]), []
    plan, folder = read_plan(write_study(tmp_path, TWELVE)), StudyFolder(tmp_path / "out")
    with folder.open(plan), serial() as pool:
        pool.count_slots = lambda: next(counts, 3)
        report = run_study(plan, folder, pool, tmp_path, cheap, told.append)
    assert report.finished == 12 and pool.slots == 3
    assert [event.error for event in told if event.kind == "waiting"] == ["the cluster has no workers"]


def test_only_frames_that_another_case_needs_are_kept(tmp_path):
    kept = []

    def spy(case, task):
        kept.append((case.sensor.max_frame_rate_hz, task.keeps_hits))
        return cheap(case, task)

    text = "[constraints]\nduration_s = 1\nat_max_frame_rate = true\n[axes]\n"
    text += "sensor.max_frame_rate_hz = [2, 10]\n"
    fly(tmp_path, text, fly_one=spy)
    assert kept == [(2.0, (0.0, 0.5)), (10.0, (0.0, 0.5))]


def test_the_time_left_follows_from_the_work_not_from_the_number_of_cases(tmp_path):
    text = "[axes]\nsensor.oversampling = [1, 3]\nsensor.dsnu_e = [0, 1]\n"
    plan = read_plan(write_study(tmp_path, text))
    pace = StudyPace(plan, StudyFolder(tmp_path / "out"), plan.cases)
    one, nine, *_ = (estimate_cpu_s(case) for case in plan.cases.values())
    assert not pace.is_measured and pace.whole == pytest.approx(2 * one + nine)
    small = next(key for key, case in plan.cases.items() if case.sensor.oversampling == 1)
    pace.add(small, 10.0)
    assert pace.is_measured and pace.remaining_s(1) == pytest.approx(10 * (1 + nine / one))
    assert pace.remaining_s(2) == pytest.approx(10 * nine / one)  # one case outlasts the rest
    assert pace.summary(2).startswith("1/3 cases, ")


def test_the_rough_time_of_a_case_is_honest_within_a_factor_of_two():
    """Processor time of whole flights on one machine: 22 frames of quickstart, and cases of a study."""
    base = Case.from_toml(find_case("quickstart")).replace({"flight.frames": 22})
    quick_s = 162.6
    assert quick_s / 2 < estimate_cpu_s(base) < 2 * quick_s
    keys = {"flight.frames": 6, "sensor.oversampling": 1, "sensor.rows": 280, "sensor.columns": 440}
    traced_s, read_s = 24.1, 13.1
    assert read_s / 2 < estimate_cpu_s(base.replace(keys)) < 2 * read_s
    assert traced_s / 2 < estimate_cpu_s(base.replace(keys)) < 2 * traced_s


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "holiday.jpg").write_text("")
    with pytest.raises(ValueError, match="must be the folder of a study"):
        fly(tmp_path)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["holiday.jpg"]


def test_a_folder_in_use_is_refused(tmp_path):
    plan = read_plan(write_study(tmp_path, TWELVE))
    with StudyFolder(tmp_path / "out").open(plan), pytest.raises(ValueError, match="must not be in use"):
        fly(tmp_path)


def test_a_scheduler_that_does_not_answer_is_told(monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    monkeypatch.setattr("glintrack.study.workers._CONNECT_S", 1.0)
    with pytest.raises(ValueError, match="must be the address of a Dask scheduler that answers within 1 s"):
        with dask("tcp://127.0.0.1:9"):
            pass


def host(address_file):
    """A cluster in a process of its own, to be killed."""
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp://"
    ) as cluster:
        address_file.with_suffix(".part").write_text(cluster.scheduler_address)
        address_file.with_suffix(".part").rename(address_file)
        time.sleep(300)


@pytest.mark.slow
def test_a_cluster_that_is_killed_is_told_and_leaves_what_is_finished(tmp_path):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    text = f"[axes]\nsensor.dsnu_e = [0, 1, 2, 3, 4, 5, 6, 7]\n[base]\nsensor.read_noise_e = {SLOW}\n"
    plan, folder = read_plan(write_study(tmp_path, text)), StudyFolder(tmp_path / "out")
    address = tmp_path / "address"
    cluster = multiprocessing.get_context("spawn").Process(target=host, args=(address,))
    cluster.start()
    deadline = time.monotonic() + 120
    while not address.exists() and time.monotonic() < deadline:
        time.sleep(0.1)

    def callback(event):
        if event.kind == "finished":
            cluster.kill()

    with folder.open(plan), dask(address.read_text()) as pool:
        with pytest.raises(ValueError, match="`scheduler` must stay up"):
            run_study(plan, folder, pool, tmp_path, cheap, callback)
    cluster.join()
    whole = sum(folder.outcome(key) is not None for key in plan.cases)
    assert 1 <= whole < 8
    report, table, _ = fly(tmp_path, text)  # the study resumes without it
    assert (report.finished_before, report.finished) == (whole, 8 - whole)
    assert set(table["status"]) == {"finished"}


def test_an_interrupt_keeps_what_is_finished(tmp_path):
    calls = []

    def stopped(case, task):
        calls.append(case)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return cheap(case, task)

    report, table, _ = fly(tmp_path, fly_one=stopped)
    assert report.interrupted and report.finished == 3
    assert sum(table["status"] == "finished") == 6


def test_a_score_that_does_not_exist_is_null_in_json_and_nan_in_the_table(tmp_path):
    def blind(case, task):
        found = cheap(case, task)
        found["scores"]["pan"] |= {"purity": math.nan, "over_time": {"purity": [0.5, math.nan]}}
        return found

    _, table, folder = fly(tmp_path, fly_one=blind)
    paths = list((folder.path / "cases").glob("*/scores.json"))
    texts = [path.read_text() for path in paths] + table["over_time"].tolist()
    assert len(paths) == 12 and not any("NaN" in text for text in texts)
    assert (table["purity"].isna() == (table["channel"] == "pan")).all()
