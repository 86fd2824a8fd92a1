"""The recipes for Slurm and Kubernetes: what they ask a cluster for, and that it works without one."""

import contextlib
import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from glintrack.study import StudyFolder, dask, read_plan, run_study, serial, write_results
from tests.study.cases import cheap, write_study

RECIPES = Path(__file__).parents[2] / "examples" / "clusters"
ONE_THREAD = [f"{name}_NUM_THREADS" for name in ("OPENBLAS", "OMP", "MKL", "NUMBA")]
FOUR = "[axes]\nsensor.pitch_um = [17, 10.8, 8.5]\natmosphere.aerosol = ['clear', 'urban']\n"


def recipe(name):
    """A recipe as a module."""
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def table(tmp_path, name, pool, cases=FOUR):
    """Results of four cheap cases, or of others."""
    plan, folder = read_plan(write_study(tmp_path, cases)), StudyFolder(tmp_path / name)
    (tmp_path / "scratch").mkdir(exist_ok=True)
    with folder.open(plan), pool as workers:
        assert run_study(plan, folder, workers, tmp_path / "scratch", cheap).finished == len(plan.cases)
        return write_results(plan, folder)


@pytest.fixture
def tests_importable(monkeypatch):
    """Workers import the cases that cost nothing from here."""
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in paths if p))


def test_a_slurm_job_is_one_worker_of_one_thread_with_its_memory():
    pytest.importorskip("dask_jobqueue", reason="needs dask-jobqueue")
    build = recipe("slurm").build_cluster
    with build("4GB", "04:00:00", ("module load python",), queue="short", interface="lo") as cluster:
        lines = cluster.job_script().splitlines()
    asked = {line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH")}
    assert {"-n 1", "--cpus-per-task=1", "--mem=4G", "-t 04:00:00", "-p short"} <= asked
    *_, module, threads, worker = (line for line in lines if line and not line.startswith("#"))
    assert module == "module load python"
    assert threads == "export " + " ".join(f"{name}=1" for name in ONE_THREAD)
    assert worker.startswith(f"{sys.executable} -m distributed.cli.dask_worker tcp://")
    for part in ("--nthreads 1", "--memory-limit 3.73GiB", "--nanny"):
        assert part in worker


@pytest.mark.slow
def test_a_study_flies_on_workers_that_a_queue_starts(tmp_path, tests_importable):
    """dask-jobqueue's own job class for tests: the same job scripts, run as processes of this machine."""
    local = pytest.importorskip("dask_jobqueue.local", reason="needs dask-jobqueue")
    expected = table(tmp_path, "here", serial())
    with local.LocalCluster(cores=1, processes=1, memory="4GB", interface="lo") as cluster:
        cluster.scale(jobs=1)
        cluster.wait_for_workers(1)
        pd.testing.assert_frame_equal(table(tmp_path, "jobs", dask(cluster.scheduler_address)), expected)


def test_a_kubernetes_worker_has_one_thread_one_core_and_its_memory():
    pytest.importorskip("dask_kubernetes", reason="needs dask-kubernetes")
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    spec = recipe("kubernetes").cluster_spec("trade", "glintrack:0.1.0", 100, "4Gi")
    assert (spec["kind"], spec["metadata"]["name"]) == ("DaskCluster", "trade")
    assert spec["spec"]["worker"]["replicas"] == 100
    (worker,) = spec["spec"]["worker"]["spec"]["containers"]
    assert worker["args"][:4] == ["dask", "worker", "--nthreads", "1"]
    assert worker["resources"]["limits"] == worker["resources"]["requests"] == {"cpu": "1", "memory": "4Gi"}
    assert {e["name"]: e["value"] for e in worker["env"]} == dict.fromkeys(ONE_THREAD, "1")
    (scheduler,) = spec["spec"]["scheduler"]["spec"]["containers"]
    assert worker["image"] == scheduler["image"] == "glintrack:0.1.0"


@contextlib.contextmanager
def running(container, **more):
    """A container's command as a process of this machine, ended afterwards."""
    given = {e["name"]: e["value"] for e in container["env"]} | more
    words = [given.get(word.removeprefix("$(").removesuffix(")"), word) for word in container["args"]]
    # the console script of this interpreter's environment, which need not be on the path
    words[:1] = [sys.executable, "-m", "dask"]
    process = subprocess.Popen(words, env={**os.environ, **given}, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(30)


@pytest.mark.slow
def test_a_study_flies_on_what_kubernetes_would_start(tmp_path, tests_importable):
    """The commands of the two containers, as they stand, with the variables that Dask's operator adds."""
    pytest.importorskip("dask_kubernetes", reason="needs dask-kubernetes")
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    spec = recipe("kubernetes").cluster_spec("trade", "glintrack:0.1.0", 1, "4Gi")["spec"]
    (worker,), (scheduler,) = (spec[kind]["spec"]["containers"] for kind in ("worker", "scheduler"))
    expected = table(tmp_path, "here", serial())
    told = tmp_path / "scheduler.json"
    scheduler = {**scheduler, "args": [*scheduler["args"], "--port", "0", "--scheduler-file", str(told)]}
    worker = {**worker, "args": [*worker["args"][:-1], "0"]}  # of the dashboard, whose port may be taken here
    with running(scheduler):
        deadline = time.monotonic() + 120
        while not told.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        address = pd.read_json(told, typ="series")["address"]
        with running(worker, DASK_SCHEDULER_ADDRESS=address, DASK_WORKER_NAME="pod-1"):
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(1, timeout=120)
            pd.testing.assert_frame_equal(table(tmp_path, "pods", dask(address)), expected)
