"""The recipes of docs/guide/cluster, and campaigns on hosts with addresses of their own."""

from __future__ import annotations

import importlib.util
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from campaign_examples import CLUSTER, InProcess, plan, table_bytes
from places import ROOT
from typer.testing import CliRunner

import sortie
from sortie.sim.campaign.drive import run_campaign
from sortie.sim.cli.app import app

RECIPES = ROOT / "docs/guide/cluster"
MANIFEST: list[dict[str, Any]] = list(yaml.safe_load_all((RECIPES / "kubernetes.yaml").read_text("utf-8")))
PODS = {one["metadata"]["name"]: one["spec"]["template"] for one in MANIFEST if "template" in one["spec"]}


# --- SLURM ------------------------------------------------------------------------------------------


@pytest.fixture
def jobqueue() -> None:
    """dask-jobqueue, without the handler of Ctrl-C that its import leaves behind."""
    before = signal.getsignal(signal.SIGINT)
    pytest.importorskip("dask_jobqueue")
    signal.signal(signal.SIGINT, before)


@contextmanager
def _recipe() -> Iterator[ModuleType]:
    """The module slurm.py."""
    spec = importlib.util.spec_from_file_location("slurm_recipe", RECIPES / "slurm.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module


BY_LOCAL_JOBS = """
import sys
from pathlib import Path
from dask_jobqueue.local import LocalCluster

folder, campaign, out = sys.argv[1:]
sys.path.insert(0, folder)
import slurm

if __name__ == "__main__":
    with LocalCluster(**slurm.options_of_jobs(1, "2GB"), log_directory=None) as cluster:
        code = slurm.fly(cluster, 2, campaign, Path(out))
        print(len(cluster.scheduler.workers), "workers")
    sys.exit(code)
"""
"""In a process of its own: dask-jobqueue leaves processes behind."""


@CLUSTER
@pytest.mark.slow
def test_the_slurm_recipe_flies_the_same_rows_by_local_jobs(
    jobqueue: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    p, out = plan(tmp_path), tmp_path / "joined"
    run_campaign(p, tmp_path / "alone", InProcess())
    command = [sys.executable, "-c", BY_LOCAL_JOBS, str(RECIPES), str(tmp_path / "small_ones.yaml"), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ["2 workers"]), done.stderr
    assert table_bytes(out) == table_bytes(tmp_path / "alone")
    assert (out / "report.md").is_file()


def test_a_job_of_the_slurm_recipe_has_a_worker_for_each_core(jobqueue: None, tmp_path: Path) -> None:
    from dask_jobqueue.slurm import SLURMJob

    files = [tmp_path / name for name in ("ca.pem", "cert.pem", "key.pem")]
    with _recipe() as slurm:
        options = slurm.options_of_jobs(4, "8GB", files)
    script = SLURMJob("tls://head:8786", name="w", queue="normal", walltime="04:00:00", **options).job_script()
    assert {"#SBATCH -p normal", "#SBATCH --cpus-per-task=4", "#SBATCH -t 04:00:00"} <= set(script.splitlines())
    words = shlex.split(script.splitlines()[-1])
    for name, value in (("--nworkers", "4"), ("--nthreads", "1"), ("--tls-ca-file", str(files[0])), ("--tls-key", str(files[2]))):  # fmt: skip
        assert words[words.index(name) + 1] == value


# --- Kubernetes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["1.28.0", "1.34.0"])
@pytest.mark.parametrize("number", range(len(MANIFEST)), ids=lambda i: MANIFEST[i]["kind"] + str(i))
def test_the_manifest_is_valid(number: int, version: str) -> None:
    """By the schemas of Kubernetes, unknown fields refused."""
    kubernetes = pytest.importorskip("kubernetes_validate")
    kubernetes.validate(MANIFEST[number], version, strict=True)


def test_the_manifest_s_parts_fit_together() -> None:
    (service,) = (one for one in MANIFEST if one["kind"] == "Service")
    (claim,) = (one for one in MANIFEST if one["kind"] == "PersistentVolumeClaim")
    assert service["spec"]["selector"].items() <= PODS["sortie-scheduler"]["metadata"]["labels"].items()
    (port,) = service["spec"]["ports"]
    address = f"tcp://{service['metadata']['name']}:{port['port']}"
    containers = {name: pod["spec"]["containers"][0] for name, pod in PODS.items()}
    assert containers["sortie-scheduler"]["ports"] == [{"name": port["targetPort"], "containerPort": port["port"]}]
    assert all(address in containers[name]["command"] for name in ("sortie-worker", "sortie-campaign"))
    for one in MANIFEST:
        assert one["metadata"]["labels"] == {"app": "sortie"}
        if one["kind"] == "Deployment":
            assert one["spec"]["selector"]["matchLabels"] == one["spec"]["template"]["metadata"]["labels"]
    for pod in PODS.values():
        for volume in pod["spec"].get("volumes", []):
            assert volume["persistentVolumeClaim"] == {"claimName": claim["metadata"]["name"]}
    images = {c["image"] for pod in PODS.values() for c in (*pod["spec"]["containers"], *pod["spec"].get("initContainers", []))}  # fmt: skip
    assert images == {f"sortie:{sortie.__version__.partition('+')[0]}"}


@pytest.mark.parametrize("name", PODS)
def test_the_manifest_s_commands_have_the_options_that_it_gives(name: str) -> None:
    pytest.importorskip("distributed")
    program, part, *words = PODS[name]["spec"]["containers"][0]["command"]
    if program == "sortie":
        known = CliRunner().invoke(app, [part, "run", "--help"], env={"COLUMNS": "200", "TERM": "dumb"}).output
    else:
        command = [sys.executable, "-m", program, part, "--help"]
        known = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    options = [word for word in words if word.startswith("--")]
    assert options
    assert [option for option in options if not re.search(rf"{option}\b", known)] == []
