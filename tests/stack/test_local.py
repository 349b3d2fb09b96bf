"""Worker processes that the package starts itself."""

from __future__ import annotations

import platform

import dask
import distributed  # noqa: F401 - its settings
import numpy as np
import pytest

from napari_shadowinv.stack._local import local_client

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
