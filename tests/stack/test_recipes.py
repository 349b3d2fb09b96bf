"""The recipe for Slurm, as the page has it, on a cluster imitated by a shell.

`sbatch` starts the job on this machine, with one worker in its process, and `scancel` ends it;
scheduler, worker and the store are real.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

from helpers.pages import blocks, text_of
from napari_shadowinv import read
from napari_shadowinv.io.store import DONE

PAGE = text_of("docs/batch.md")
SOURCES = Path(sys.modules["napari_shadowinv"].__file__ or "").parents[1]
PATIENCE = 120

SBATCH = """#!/bin/sh
job=$(ls "$FAKE_SLURM" | grep -c sh$)
cp "$1" "$FAKE_SLURM/$job.sh"
sed "s/--nworkers [0-9]*/--nworkers 1/; s/--nanny/--no-nanny/" "$1" >"$FAKE_SLURM/$job.run"
SLURM_JOB_ID=$job setsid sh "$FAKE_SLURM/$job.run" >"$FAKE_SLURM/$job.log" 2>&1 &
echo $! >"$FAKE_SLURM/$job.pid"
echo "Submitted batch job $job"
"""
SCANCEL = """#!/bin/sh
kill -TERM -- -$(cat "$FAKE_SLURM/$1.pid")
touch "$FAKE_SLURM/$1.cancelled"
"""


@pytest.fixture
def project(night, tmp_path) -> Path:
    """The folder that the recipe calls /project."""
    folder = tmp_path / "project"
    (folder / "shots").mkdir(parents=True)
    for index, image in enumerate(night.images):
        tifffile.imwrite(folder / "shots" / f"shot_{index}.tif", image.astype(np.float32))
    tifffile.imwrite(folder / "reference.tif", night.source.astype(np.float32))
    return folder


@pytest.fixture
def slurm(tmp_path):
    """An environment with Slurm's commands; jobs that are left are ended."""
    if os.name != "posix" or not shutil.which("setsid"):
        pytest.skip("the jobs are groups of processes")
    commands, jobs = tmp_path / "bin", tmp_path / "jobs"
    commands.mkdir()
    jobs.mkdir()
    for name, text in {"sbatch": SBATCH, "scancel": SCANCEL}.items():
        (commands / name).write_text(text)
        (commands / name).chmod(0o755)
    yield {
        **os.environ,
        "PATH": os.pathsep.join([str(commands), os.environ["PATH"]]),
        "PYTHONPATH": os.pathsep.join([str(SOURCES), os.environ.get("PYTHONPATH", "")]),
        "FAKE_SLURM": str(jobs),
        # Everything on this machine's loopback.
        "DASK_JOBQUEUE__SLURM__INTERFACE": "lo",
        "DASK_JOBQUEUE__SLURM__SCHEDULER_OPTIONS": '{"dashboard_address": "127.0.0.1:0"}',
        "DASK_JOBQUEUE__SLURM__WORKER_EXTRA_ARGS": '["--no-dashboard"]',
    }
    for pid in jobs.glob("*.pid"):
        end_group(int(pid.read_text()))


def end_group(leader: int) -> None:
    try:
        os.killpg(leader, signal.SIGKILL)
    except ProcessLookupError:
        return


@pytest.mark.skipif(sys.platform != "linux", reason="the loopback's name is lo")
def test_the_recipe_for_slurm_inverts_a_stack(project, slurm, tmp_path):
    pytest.importorskip("dask_jobqueue")
    (recipe,) = (block for block in blocks(PAGE, "python") if "SLURMCluster" in block)
    for theirs, ours in (("/project", str(project)), ("32,", "2,"), ("64GB", "2GB")):
        assert theirs in recipe
        recipe = recipe.replace(theirs, ours)
    # Small, as the machine of a test is; else as it stands there.
    recipe = recipe.replace("maximum_jobs=8", "maximum_jobs=1").replace(
        '"/tmp"', repr(str(tmp_path))
    )
    script = tmp_path / "recipe.py"
    script.write_text(recipe)
    subprocess.run([sys.executable, script], env=slurm, timeout=PATIENCE, check=True, cwd=tmp_path)
    assert list(read(project / "night.shadowinv.zarr").status) == [DONE] * 6
    jobs = Path(slurm["FAKE_SLURM"])
    job = (jobs / "0.sh").read_text()
    assert "#SBATCH --cpus-per-task=2" in job
    assert "#SBATCH -t 04:00:00" in job
    for words in ("--nthreads 1 ", "--nworkers 2 ", "--memory-limit 0.93GiB "):
        assert words in job
    # The job is given back as soon as the run is over.
    assert (jobs / "0.cancelled").exists()
