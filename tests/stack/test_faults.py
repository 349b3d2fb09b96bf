"""Faults during a night: real schedulers, real worker processes, real signals."""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
import time
from collections import Counter
from pathlib import Path

import dask
import numpy as np
import pytest
from distributed import Client, LocalCluster

from helpers.forked import run_files, serve
from helpers.slow_reading import die, hang_once
from helpers.store_content import content, whole_content
from napari_shadowinv import FileFormatError, InversionOptions, read
from napari_shadowinv._system.machine import available_threads
from napari_shadowinv.errors import RunInterruptedError
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore
from napari_shadowinv.stack import _schedulers
from napari_shadowinv.stack._worker import threads_here

OPTIONS = InversionOptions(n_sites=100)
PATIENCE = 90.0


def wait_for(condition, what: str):
    end = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < end, f"waited {PATIENCE} s for {what}"
        time.sleep(0.1)  # conditions that read a store take time from the workers
    return value


@pytest.fixture(scope="module")
def cluster(compiled, forked):
    with LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as made:
        yield made


class InThread(threading.Thread):
    """A run that the test watches from outside."""

    def __init__(self, night, out: Path, **changes) -> None:
        super().__init__(daemon=True)
        self._work = lambda: night.run(out, **changes)
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            self.error = error

    def ended(self) -> BaseException | None:
        self.join(PATIENCE)
        assert not self.is_alive()
        return self.error


def test_a_worker_killed_in_the_middle_of_a_shot(night, out, expected, cluster):
    (night.folder / "hang.txt").write_text("shot_2")
    run = InThread(night, out, reader=hang_once, scheduler=cluster.scheduler_address)
    run.start()
    victim = int(wait_for(lambda: read_text(night.folder / "hanging"), "a shot to begin"))
    assert victim != os.getpid()
    os.kill(victim, signal.SIGKILL)
    assert run.ended() is None
    assert content(out) == expected
    assert (read(out).status == DONE).all()
    # Another worker did it again, and nothing else was done twice.
    assert Counter(night.reads)["shot_2"] == 1


def read_text(path: Path) -> str:
    return path.read_text() if path.exists() else ""


def test_killed_client_resumes_and_a_second_one_is_refused(night, out, expected, cluster, forked):
    np.save(night.folder / "source.npy", night.source)
    (night.folder / "hang.txt").write_text("shot_3")
    arguments = {"reader": hang_once, "scheduler": cluster.scheduler_address}
    client = forked.Process(
        target=run_files, args=(night.folder, out, cluster.scheduler_address), daemon=True
    )
    client.start()
    try:
        wait_for(lambda: read_text(night.folder / "hanging"), "a shot to begin")
        wait_for(lambda: (StackStore(out).statuses() == DONE).sum() == 5, "the other shots")
        with pytest.raises(FileFormatError, match="being written by another process"):
            night.run(out, **arguments)
    finally:
        client.kill()
        client.join()
    assert list(np.flatnonzero(read(out).status == PENDING)) == [3]
    reads = Counter(night.reads)
    # The lock of the dead is none; the worker that is still at the shot may go on.
    run = InThread(night, out, **arguments)
    run.start()
    (night.folder / "release").touch()
    assert run.ended() is None
    assert content(out) == expected
    again = Counter(night.reads) - reads
    assert not {"shot_4", "shot_5"} & set(again)


@pytest.mark.skipif(os.name != "posix", reason="processes are killed by a signal")
def test_a_run_killed_at_any_change_of_a_file_is_resumed_bit_by_bit(night, out, tmp_path, forked):
    undisturbed = tmp_path / "undisturbed.shadowinv.zarr"
    night.run(undisturbed, reader=hang_once)
    np.save(night.folder / "source.npy", night.source)
    codes = []
    # While it creates the store, and writes its shots.
    for change in (30, 85, 100, 20, 5, 35, 25, 12, 18, 15, 0):
        run = forked.Process(target=run_files, args=(night.folder, out, "synchronous", change))
        run.start()
        run.join()
        codes.append(run.exitcode)
    assert codes.count(-signal.SIGKILL) > 6
    assert codes[-1] == 0
    assert whole_content(out) == whole_content(undisturbed)
    assert {path.name for path in tmp_path.iterdir()} == {"shots", out.name, undisturbed.name}
    assert not [path for path in out.rglob("*") if re.search(r"^\.|\.partial$", path.name)]


def test_what_shots_share_is_sent_to_a_cluster_without_a_warning(night, out, cluster, recwarn):
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 kB"}):
        night.run(out, shots=night.images, scheduler=cluster.scheduler_address)
    assert not [warning for warning in recwarn if "large graph" in str(warning.message)]


def test_a_dask_array_on_the_cluster_is_inverted_there(night, out, expected, cluster):
    import dask.array as da

    with Client(cluster) as client:
        shots = client.persist(da.from_array(night.images, chunks=(2, 24, 28)))
        night.run(out, shots=shots)  # dask's current client
    assert content(out) == expected


def test_shots_on_a_cluster_share_the_cores_of_its_machine(cluster):
    with Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=PATIENCE)  # one may have died in the test before
        with _schedulers.scheduler_for(client) as chosen:
            assert chosen.workers == 2
    assert threads_here(chosen.workers) == max(1, available_threads(None) // 2)


def test_a_shot_whose_worker_always_dies_fails_with_this_reason(make_night, out, cluster):
    night = make_night(1)
    cluster.scheduler.allowed_failures = 0
    written = night.run(out, reader=die, scheduler=cluster.scheduler_address)
    assert list(written.status) == [FAILED]
    assert "the worker crashed on every attempt" in StackStore(out).report(0)["reason"]


def test_the_scheduler_restarted_and_the_run_resumed(night, out, expected, forked):
    (night.folder / "hang.txt").write_text("shot_3")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    servers = [forked.Process(target=serve, args=(port,), daemon=True) for _ in range(2)]
    try:
        servers[0].start()
        run = InThread(night, out, reader=hang_once, scheduler=address)
        run.start()
        wait_for(lambda: read_text(night.folder / "hanging"), "a shot to begin")
        servers[0].kill()
        error = run.ended()
        assert isinstance(error, OSError)
        assert "run again to resume" in str(error)
        before = read(out)
        assert (before.status == PENDING).any()
        assert not (before.status == FAILED).any()
        servers[1].start()
        written = night.run(out, reader=hang_once, scheduler=address)
    finally:
        for server in servers:
            if server.pid is not None:
                server.kill()
                server.join()
    assert (written.status == DONE).all()
    assert content(out) == expected


def test_no_scheduler_answers(night, out, monkeypatch):
    monkeypatch.setattr(_schedulers, "_CONNECT_TIMEOUT_S", 1.0)
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{closed.getsockname()[1]}"
        with pytest.raises(OSError, match=f"no scheduler responds at {address}"):
            night.run(out, scheduler=address)
    assert not out.exists()


def test_the_disk_full_while_writing(make_night, small_disk):
    night = make_night(40)
    folder, resize = small_disk
    out = folder / "night.shadowinv.zarr"
    with pytest.raises(RunInterruptedError, match="device\\): free some disk space") as refused:
        night.run(out)
    assert refused.value.option == "resume"  # as a command names it
    before = read(out)
    done = before.status.values == DONE
    assert 0 < done.sum() < 40
    assert not (before.status == FAILED).any()
    assert np.isfinite(before.potential.values[done]).all()
    finished = {name: text for name, text in content(out).items() if done[shot_of(name)]}
    assert resize("16m")
    after = night.run(out)
    assert (after.status == DONE).all()
    assert np.isfinite(after.potential.values).all()
    assert finished.items() <= content(out).items()


def shot_of(name: str) -> int:
    return int(Path(name).parts[2])


def test_the_next_run_removes_the_hidden_files_of_killed_ones(night, out):
    for ending in ("new", "old"):
        left = out.with_name(f".{out.name}.{ending}")
        left.mkdir()
        (left / "zarr.json").write_text("half")
    out.with_name(f".{out.name}.lock").touch()
    night.run(out)
    assert not list(out.parent.glob(".*"))
    for ending in ("lock", "part.json"):
        (out / f".zarr.json.{ending}").write_text("half")
    assert (night.run(out).status == DONE).all()
    assert not list(out.rglob(".*"))
