"""The status of a run: numbers of shots and rate, as all faces show them."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv import Instrument, InversionOptions
from napari_shadowinv.io.store import StackStore
from napari_shadowinv.stack import RunStatus


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (RunStatus(total=4, done=4), "4 of 4 done"),
        (RunStatus(total=4, done=2, failed=1, waiting=1), "2 of 4 done, 1 failed"),
        (RunStatus(total=4, done=4, doubtful=3), "4 of 4 done, 3 with warnings"),
    ],
)
def test_text_names_numbers_above_zero_and_the_rest_follows_from_them(status, text):
    assert status.text == text
    status = RunStatus(total=12, done=8, failed=1, waiting=3, ended=6, seconds=12.0)
    assert status.rate == 0.5


def test_status_counts_shots_of_earlier_runs(make_night, out):
    night = make_night(4)
    np.save(night.path(1), 0 * night.images[1])
    few = InversionOptions(n_sites=8)  # too few sites for the image: a warning
    exact = Instrument(beam_rms=0)  # so that the warnings are about the field
    events: list[RunStatus] = []
    night.run(out, options=few, instrument=exact, on_progress=events.append)
    last = [event for event in events if not event.stage][-1]
    warned = sum(bool(report.get("warnings")) for report in StackStore(out).reports())
    assert (last.total, last.done, last.failed, last.waiting, last.ended) == (4, 3, 1, 0, 4)
    assert last.doubtful == warned > 0
    assert [name for name, _ in last.failures] == ["shot_1.npy"]
    events.clear()
    night.run(out, options=few, instrument=exact, on_progress=events.append)
    again = events[-1]
    assert (again.done, again.failed, again.doubtful, again.ended) == (3, 1, warned, 0)
    assert again.failures == last.failures
