"""A study on Kubernetes: workers are pods, started by dask-kubernetes (``pip install dask-kubernetes``).

    python kubernetes.py --image registry.example.org/glintrack:0.1.0 --workers 100 -- glintrack study table1

The cluster needs Dask's operator (https://kubernetes.dask.org), the image the same glintrack with the extra
``cluster`` as this host. Results come back to this host; kept hits are each pod's own, unless ``--cache``
names a volume that the specification mounts. ``--spec`` prints the specification, for ``kubectl apply``.
"""

import argparse
import json
import subprocess
import sys
import threading

from dask_kubernetes.operator import KubeCluster, make_cluster_spec

THREADS = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


def cluster_spec(name: str, image: str, workers: int, memory: str) -> dict:
    """Describe a scheduler, and pods of one core with one thread each, for Dask's operator.

    Parameters
    ----------
    name, image, workers
        Of the cluster, of every container, and how many.
    memory
        Of each worker, as Kubernetes writes it, such as ``4Gi``.
    """
    spec = make_cluster_spec(
        name=name,
        image=image,
        n_workers=workers,
        # without a limit of cores a worker would fly as many cases at a time as its node has cores
        resources={"requests": {"cpu": "1", "memory": memory}, "limits": {"cpu": "1", "memory": memory}},
        env=THREADS,
        worker_command="dask worker --nthreads 1",
    )
    # make_cluster_spec still calls dask-scheduler, which distributed 2026.8 no longer has
    scheduler = spec["spec"]["scheduler"]["spec"]["containers"][0]
    scheduler["args"] = ["dask", "scheduler", *scheduler["args"][1:]]
    return spec


def main() -> int:
    """Start the pods and run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--image", required=True)
    parser.add_argument("--name", default="glintrack")
    parser.add_argument("--workers", type=int, default=10)
    parser.add_argument("--memory", default="4Gi")
    parser.add_argument("--spec", action="store_true", help="print the specification and end")
    parser.add_argument("command", nargs="*", help="of glintrack, after --")
    given = parser.parse_args()
    spec = cluster_spec(given.name, given.image, given.workers, given.memory)
    if given.spec:
        print(json.dumps(spec, indent=2))
        return 0
    with KubeCluster(custom_cluster_spec=spec) as cluster:
        print(f"scheduler {cluster.scheduler_address}, {given.workers} pods asked for", flush=True)
        if not given.command:
            threading.Event().wait()
        cluster.wait_for_workers(1)
        return subprocess.run(
            [*given.command, "--scheduler", cluster.scheduler_address], check=False
        ).returncode


if __name__ == "__main__":
    sys.exit(main())
