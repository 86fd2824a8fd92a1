"""A study on Slurm: workers are jobs, started by dask-jobqueue (``pip install dask-jobqueue``).

    python slurm.py --jobs 100 -- glintrack study table1 --cache /scratch/hits

Run it where ``sbatch`` works and the jobs can reach this host. It waits for the first job, runs the command
with ``--scheduler ADDRESS`` added, and ends the jobs after it; jobs that start later join in. If the time of
the jobs runs out, run it again: the study resumes. Without a command it prints the address and waits.
"""

import argparse
import subprocess
import sys
import threading

from dask_jobqueue import SLURMCluster

# one thread each, set before the libraries load: a job has one core
THREADS = "export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 NUMBA_NUM_THREADS=1"


def build_cluster(memory: str, walltime: str, prologue: tuple[str, ...] = (), **more) -> SLURMCluster:
    """Start a scheduler in this process; each job is one worker with one core.

    Parameters
    ----------
    memory, walltime
        Of each job, as ``4GB`` and ``04:00:00``.
    prologue
        Lines of the job's script before the worker starts, such as ``module load python``.
    more
        Of ``SLURMCluster``, such as ``queue``, ``account`` or ``interface``.
    """
    return SLURMCluster(
        cores=1,
        processes=1,
        memory=memory,
        walltime=walltime,
        job_script_prologue=[*prologue, THREADS],
        **more,
    )


def main() -> int:
    """Start the jobs and run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=10)
    parser.add_argument("--memory", default="4GB")
    parser.add_argument("--walltime", default="04:00:00")
    parser.add_argument("--queue", help="Slurm's partition")
    parser.add_argument("--account")
    parser.add_argument("--interface", help="network interface that jobs and this host share")
    parser.add_argument("--script", action="store_true", help="print the script of a job and end")
    parser.add_argument("command", nargs="*", help="of glintrack, after --")
    given = parser.parse_args()
    more = {name: getattr(given, name) for name in ("queue", "account", "interface") if getattr(given, name)}
    with build_cluster(given.memory, given.walltime, **more) as cluster:
        if given.script:
            print(cluster.job_script())
            return 0
        cluster.scale(jobs=given.jobs)
        print(f"scheduler {cluster.scheduler_address}, {given.jobs} jobs asked for", flush=True)
        if not given.command:
            threading.Event().wait()
        cluster.wait_for_workers(1)
        return subprocess.run(
            [*given.command, "--scheduler", cluster.scheduler_address], check=False
        ).returncode


if __name__ == "__main__":
    sys.exit(main())
