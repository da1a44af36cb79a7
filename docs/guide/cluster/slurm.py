"""Fly a campaign on a SLURM cluster: the workers are jobs of the queue, and this command writes the results.

    python slurm.py my.yaml --out runs/my --jobs 20 --cores 16 --memory 32GB --queue normal --walltime 04:00:00

Start it on a node that the compute nodes can reach. It runs until the campaign ends, and then its jobs are cancelled. After an
interruption the same command continues. It needs `pip install dask-jobqueue`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import dask
from dask_jobqueue import SLURMCluster
from distributed import Security

WAIT_S = 7 * 24 * 3600
"""How long the campaign waits for the queue to start a first job."""


def options_of_jobs(cores: int, memory: str, security: Sequence[Path] = ()) -> dict[str, Any]:
    """What every job is like, for a cluster class of dask-jobqueue: one worker process for each core.

    Args:
        cores: of one job.
        memory: of one job, such as "32GB".
        security: PEM files of the authority's certificate, your certificate and its key, for TLS; nothing for none.
    """
    options: dict[str, Any] = {"cores": cores, "processes": cores, "memory": memory}
    if security:
        ca, cert, key = map(str, security)
        ours = {f"tls_{who}_{what}": path for who in ("client", "scheduler", "worker") for what, path in (("cert", cert), ("key", key))}  # fmt: skip
        options |= {"protocol": "tls://", "security": Security(require_encryption=True, tls_ca_file=ca, **ours)}
    return options


def fly(cluster: Any, jobs: int, campaign: str, out: Path, security: Sequence[Path] = ()) -> int:
    """Keep so many jobs in the queue while the campaign flies; returns the exit code of `sortie campaign`."""
    cluster.adapt(minimum_jobs=jobs, maximum_jobs=jobs)  # `scale` would not replace jobs that reach their wall time
    command = [sys.executable, "-m", "sortie", "campaign", campaign, "--out", str(out)]
    command += ["--scheduler", cluster.scheduler_address, "--wait-for-workers", str(WAIT_S)]
    command += ["--security", *map(str, security)] if security else []
    return subprocess.run(command, check=False).returncode  # noqa: S603 - the command above


def main() -> int:
    """Make the cluster and fly."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", help="a campaign file on a disk that all nodes share")
    parser.add_argument("--out", type=Path, required=True, help="the campaign's folder")
    parser.add_argument("--jobs", type=int, default=4, help="number of jobs (default: %(default)s)")
    parser.add_argument("--cores", type=int, default=16, help="cores of a job (default: %(default)s)")
    parser.add_argument("--memory", default="32GB", help="memory of a job (default: %(default)s)")
    parser.add_argument("--queue", help="the partition; default: the cluster's own")
    parser.add_argument("--account", help="the account that pays")
    parser.add_argument(
        "--walltime", default="01:00:00", help="of a job; the next job replaces it (default: %(default)s)"
    )
    parser.add_argument("--interface", help="the network device between the nodes, such as ib0")
    parser.add_argument(
        "--security", type=Path, nargs=3, default=(), metavar=("CA", "CERT", "KEY"), help="PEM files for TLS"
    )
    given = parser.parse_args()
    # a job that reaches its wall time is no fault of the runs that it was flying
    dask.config.set({"distributed.scheduler.allowed-failures": 10})
    with SLURMCluster(
        queue=given.queue, account=given.account, walltime=given.walltime, interface=given.interface,
        **options_of_jobs(given.cores, given.memory, given.security),
    ) as cluster:  # fmt: skip
        return fly(cluster, given.jobs, given.campaign, given.out, given.security)


if __name__ == "__main__":
    sys.exit(main())
