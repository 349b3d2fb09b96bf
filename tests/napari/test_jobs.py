"""Time and progress of a fit: estimated before it, and shown while it runs."""

from __future__ import annotations

import pytest

from napari_shadowinv import ProtonSetup, fit
from napari_shadowinv._napari.jobs import FitProgress, TimeEstimate
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.shot import shots_of

OPTIONS = FitOptions(samples=2)
SETUPS = [
    ProtonSetup(
        energy=energy, source_object_distance=1e-3, object_image_distance=2e-2, pixel_size=1e-6
    )
    for energy in (14.7, 6.0)
]


@pytest.mark.parametrize(
    ("options", "last"),
    [
        (OPTIONS, "full size and error bars"),
        (FitOptions(samples=0, max_iterations=3), "full size"),
    ],
)
def test_the_bar_never_goes_back_and_names_the_stages(options: FitOptions, last: str) -> None:
    truth = gaussian_blob((48, 48), 15.0, 8.0).displacement
    progress = FitProgress(TimeEstimate((48, 48), 2, 1, False, options))
    reports: list[Progress] = []
    fit(
        shots_of(
            [synthetic_image(truth), synthetic_image(0.6 * truth)], strength=[1, 0.6], noise=0.02
        ),
        options=options,
        on_progress=lambda report: reports.append(progress.update(report)),
    )
    reports = [report for report in reports if report.stage != "compile"]
    shares = [report.step / report.total for report in reports if report.total]
    assert len(shares) == len(reports)
    assert shares == sorted(shares)
    assert 0 < shares[0] < 0.05
    assert 0.8 < shares[-1] <= 1
    stages = dict.fromkeys(report.message.partition(" (")[0] for report in reports)
    expected = ["stage 1 of 3, starts", "stage 2 of 3, smoothness", f"stage 3 of 3, {last}"]
    assert list(stages) == expected
    assert "starts (transport)" in reports[0].message
    assert not any("nan" in report.text for report in reports)


def test_other_progress_is_passed_on() -> None:
    progress = FitProgress(TimeEstimate((48, 48), 2, 1, False, OPTIONS))
    compiling = Progress("compile", 1, None, "once")
    assert progress.update(compiling) is compiling
    assert progress.history == []


def test_samples_beside_the_fit_do_not_change_the_objective_shown() -> None:
    progress = FitProgress(TimeEstimate((48, 48), 2, 1, False, OPTIONS))
    steps = [("smoothness", 20.0), ("samples", 20.0), ("full size", 81.0), ("samples", 20.0)]
    shown = [progress.update(Progress("fit", 1, None, *step)).objective for step in steps]
    assert shown == [20, 20, 81, 81]
    assert progress.history == steps


def test_a_forecast_grows_with_what_is_asked_for() -> None:
    def seconds(side: int, count: int, fields: int = 1, is_unknown: bool = False) -> float:
        return TimeEstimate((side, side), count, fields, is_unknown, FitOptions()).seconds

    assert 1.2 < seconds(200, 2) < 3
    assert 0.4 < seconds(64, 2) < 1.2
    assert seconds(400, 2) > 3 * seconds(200, 2)
    assert seconds(200, 4) > 1.5 * seconds(200, 2)
    assert seconds(200, 2, fields=2) > 1.3 * seconds(200, 2)
    assert seconds(200, 2, is_unknown=True) > 1.2 * seconds(200, 2)
    none = TimeEstimate((200, 200), 2, 1, False, FitOptions(samples=0)).seconds
    assert none < seconds(200, 2)


def test_the_next_forecast_follows_the_last_fit() -> None:
    estimate = TimeEstimate((1000, 1000), 3, 2, False, FitOptions())
    text = estimate.text(None)
    assert text.startswith("3 images of 1000 × 1000 px, 2 fields: about 80 s, up to 5 min")
    assert "about 4 min, based on the last fit" in estimate.text(3.0)
    single = TimeEstimate((200, 200), 1, 1, True, FitOptions())
    assert single.text(None).startswith("one image of 200 × 200 px, unknown beam: about ")
