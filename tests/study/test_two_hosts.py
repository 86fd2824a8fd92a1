"""A study and an optimization over two hosts: network namespaces with own addresses, files and caches."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from glintrack.study import StudyFolder, serial
from glintrack.study.optimize import StudyRunner, read_optimization, run_search
from tests.study.cases import SLOW, write_study
from tests.study.optimize.cameras import camera, write_spec
from tests.study.test_clusters import table

pytest.importorskip("distributed", reason="needs the extra `cluster`")
ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}
HOSTS = {"near": "10.231.77.1", "far": "10.231.77.2"}
SCHEDULER = f"tcp://{HOSTS['near']}:8786"
CASES = f"""
design = "factorial"
seeds = [1, 2]
[axes]
sensor.pitch_um = [17, 10.8, 8.5]
atmosphere.aerosol = ["clear", "urban"]
[base]
sensor.read_noise_e = {SLOW}
"""
DRIVER = """
import sys
from pathlib import Path
from distributed import Client
from glintrack.study import dask
from tests.study.test_two_hosts import flown_by, searched_by
with Client(sys.argv[2], timeout=300, set_as_default=False) as client:
    client.wait_for_workers(1, timeout=300)
flown_by(Path(sys.argv[1]), "hosts", dask(sys.argv[2]))
searched_by(Path(sys.argv[1]), "hosts", dask(sys.argv[2]))
"""


def flown_by(tmp_path, name, pool):
    """Results of twelve slow cases, written beside the study."""
    found = table(tmp_path, name, pool, CASES)
    found.to_csv(tmp_path / f"{name}.csv", index=False)
    return found


def searched_by(tmp_path, name, pool):
    """Answer, design and scores of an optimization, written beside the study."""
    setup = read_optimization(write_spec(tmp_path / "optimization"))
    folder = StudyFolder(tmp_path / f"optimization-{name}")
    runner = StudyRunner(setup, folder, None, None, camera)
    with pool as runner.pool, folder.open(runner.plan()):
        found = run_search(runner)
    text = json.dumps([found.answer, found.design, found.observations.scores.tolist()])
    (tmp_path / f"optimization-{name}.json").write_text(text)
    return text


def ip(words):
    """Change the network of a namespace."""
    subprocess.run(["ip", *words.split()], check=True, capture_output=True)


@pytest.fixture
def hosts():
    """Names of two network namespaces that a cable connects."""
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("unshare") is None:
        pytest.skip("needs the right to mount and to make network namespaces")
    names = {host: f"glintrack-{host}-{os.getpid()}" for host in HOSTS}
    try:
        for name in names.values():
            ip(f"netns add {name}")
        ip(f"-n {names['near']} link add cable type veth peer name cable netns {names['far']}")
    except subprocess.CalledProcessError as error:
        for name in names.values():
            subprocess.run(["ip", "netns", "del", name], capture_output=True)
        pytest.skip(f"needs the right to mount and to make network namespaces: {error.stderr.decode()}")
    for host, name in names.items():
        ip(f"-n {name} addr add {HOSTS[host]}/24 dev cable")
        ip(f"-n {name} link set cable up")
        ip(f"-n {name} link set lo up")
    yield names
    for name in names.values():
        ip(f"netns del {name}")


class Worker:
    """A Dask worker on a host whose file system shows an empty folder in place of the study's."""

    def __init__(self, namespace, folder):
        words = f"{sys.executable} -m dask worker {SCHEDULER} --nworkers 1 --nthreads 1 --no-dashboard"
        caches = {
            name: f"{folder}/{name.lower()}" for name in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "TMPDIR")
        }
        script = f"mount -t tmpfs none {folder} && cd {folder} && mkdir scratch tmpdir && exec {words}"
        self.folder = folder
        self.process = subprocess.Popen(
            ["ip", "netns", "exec", namespace, "unshare", "--mount", "sh", "-c", script],
            env={**ENVIRONMENT, **caches},
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def flown(self):
        """Cases that this host has simulated, from the files in its own folder."""
        own = Path(f"/proc/{self.process.pid}/root{self.folder}/scratch")
        return {path.name.split("-")[1] for path in own.glob("flown-*")}

    def kill(self):
        """End the host without notice."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(30)


def wait_until(condition, seconds=300.0):
    """Wait for a condition; an idle machine needs 10 s."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "nothing happened in time"
        time.sleep(0.1)


@pytest.mark.slow
def test_two_hosts_give_the_results_of_one_while_a_worker_dies_and_returns(tmp_path, hosts):
    write_study(tmp_path, CASES)
    expected = flown_by(tmp_path, "here", serial())
    found_here = searched_by(tmp_path, "here", serial())
    here = set((tmp_path / "scratch").iterdir())
    enter = ["ip", "netns", "exec", hosts["near"]]
    words = f"-m dask scheduler --host {HOSTS['near']} --port 8786 --no-dashboard"
    scheduler = subprocess.Popen(
        [*enter, sys.executable, *words.split()], env=ENVIRONMENT, stderr=subprocess.DEVNULL
    )
    workers = [Worker(hosts["far"], tmp_path)]
    driver = subprocess.Popen(
        [*enter, sys.executable, "-c", DRIVER, str(tmp_path), SCHEDULER], env=ENVIRONMENT, cwd=tmp_path
    )
    try:
        wait_until(lambda: len(workers[0].flown()) > 1 or driver.poll() is not None)
        before_death = workers[0].flown()
        workers[0].kill()
        workers = [Worker(namespace, tmp_path) for namespace in hosts.values()]
        assert driver.wait(300) == 0
        near, far = (worker.flown() for worker in workers)
    finally:
        for worker in workers:
            worker.kill()
        for process in (driver, scheduler):
            process.kill()
            process.wait(30)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "hosts.csv"), pd.read_csv(tmp_path / "here.csv"))
    assert (tmp_path / "optimization-hosts.json").read_text() == found_here
    assert near and before_death
    assert len(near | far | before_death) == len(expected) // 2  # each row is of one channel
    assert set((tmp_path / "scratch").iterdir()) == here  # no worker wrote into this host's folder
