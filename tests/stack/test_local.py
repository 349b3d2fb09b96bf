"""Worker processes that the package starts itself."""

from __future__ import annotations

import asyncio
import contextlib
import platform
import ssl
import threading
import time
import urllib.error
import urllib.request

import dask
import numpy as np
import psutil  # dask needs it, too
import pytest
from distributed import Client, Security
from distributed.comm import connect

from napari_shadowinv.stack._engines import EngineError, engine_for, local_client

ROUNDS = 200


def pages_taken() -> float:
    """Return how many pages a large array takes from the system, after the first few."""
    import resource

    for _ in range(5):
        np.ones(500_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(ROUNDS):
        np.ones(500_000)
    return (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / ROUNDS


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="others have no such settings")
def test_workers_use_memory_again_that_they_had(monkeypatch):
    before = dask.config.get("distributed.nanny.pre-spawn-environ")
    # Every cluster of dask leaves this behind in the process that starts it.
    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", str(before["MALLOC_TRIM_THRESHOLD_"]))
    with local_client(1) as client:
        (pages,) = client.run(pages_taken).values()
    # 4 MB are 977 pages; given back each time, all of them are taken again.
    assert pages < 50
    assert dask.config.get("distributed.nanny.pre-spawn-environ") == before


def answers(address: str, **security: object) -> bool:
    """Return whether a scheduler or worker continues the connection after its greeting."""

    async def greet() -> None:
        comm = await connect(address, timeout=2, **security)
        await comm.write({"op": "identity", "reply": True})
        await comm.read()
        await comm.close()

    try:
        asyncio.run(greet())
    except OSError:
        return False
    return True


def test_only_who_has_the_key_of_a_run_can_talk_to_it():
    stranger = ssl.create_default_context()
    stranger.check_hostname, stranger.verify_mode = False, ssl.CERT_NONE
    other_keys = Security.temporary().get_connection_args("client")
    with local_client(1) as client:
        (worker,) = client.scheduler_info()["workers"]
        for address in (client.scheduler.address, worker):
            assert not answers(address.replace("tls:", "tcp:"))
            assert not answers(address, ssl_context=stranger)
            assert not answers(address, **other_keys)
            assert answers(address, **client.security.get_connection_args("client"))
        with Client(client.scheduler.address, security=client.security) as friend:
            assert friend.submit(sum, (1, 2)).result(timeout=30) == 3


def test_scheduler_and_workers_serve_no_pages():
    with local_client(1) as client:
        mine = psutil.Process()
        ports = [
            socket.laddr
            for process in (mine, *mine.children(recursive=True))
            for socket in process.net_connections("inet")
            if socket.status == psutil.CONN_LISTEN
        ]
        assert {ip for ip, _ in ports} == {"127.0.0.1"}
        pages = [
            client.dashboard_link,
            client.dashboard_link.replace("status", "json/identity.json"),
        ]
        for page in pages:
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(page, timeout=5)


def spawned() -> set[psutil.Process]:
    """Return the living processes that were started as workers."""
    found = set()
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it may have ended meanwhile
            if "spawn_main" in " ".join(process.cmdline()):
                found.add(process)
    return found


def test_worker_killed_while_it_starts_gives_one_sentence():
    before = spawned()  # those of earlier tests may still be ending

    def kill() -> None:
        end = time.monotonic() + 60
        while not (new := spawned() - before) and time.monotonic() < end:
            time.sleep(0.01)
        for process in new:
            process.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    message = "1 process for the shots could not be started .* then run again to resume"
    with pytest.raises(EngineError, match=message), engine_for("processes", 1):
        pass
    killer.join()
    assert not spawned() - before
