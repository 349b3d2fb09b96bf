"""Time and memory of runs, estimated before them."""

from __future__ import annotations

from typing import Any

from napari_shadowinv import InversionOptions
from napari_shadowinv.options import FitChoices, FitOptions, Instrument
from napari_shadowinv.pipeline.costs import fit_cost, inversion_cost


def test_a_forecast_grows_with_what_is_asked_for() -> None:
    def seconds(side: int, count: int, **choices: Any) -> float:
        return fit_cost((side, side), count, FitChoices(**choices)).seconds

    assert 1.2 < seconds(200, 2) < 3
    assert 0.4 < seconds(64, 2) < 1.2
    assert seconds(400, 2) > 3 * seconds(200, 2)
    assert seconds(200, 4) > 1.5 * seconds(200, 2)
    assert seconds(200, 2, fields=("B", "E")) > 1.3 * seconds(200, 2)
    assert seconds(200, 2, beam="unknown") > 1.2 * seconds(200, 2)
    assert seconds(200, 2, options=FitOptions(samples=0)) < seconds(200, 2)
    instrument, choices = Instrument(beam_between=0.05), FitChoices()
    costs = [fit_cost((200, 200), 2, choices, each).seconds for each in (Instrument(), instrument)]
    assert 2 < costs[1] / costs[0] < 3  # samples of beams between energies are fitted
    assert fit_cost((200, 200), 1, choices, instrument) == fit_cost((200, 200), 1, choices)
    quick = FitChoices(options=FitOptions(samples=0))
    assert fit_cost((200, 200), 2, quick, instrument) == fit_cost((200, 200), 2, quick)


def test_a_forecast_is_a_sentence() -> None:
    shape, choices = (1000, 1000), FitChoices(fields=("B", "E"))
    text = fit_cost(shape, 3, choices).text
    assert text.startswith("3 images of 1000 × 1000 px, 2 fields: about 80 s, up to 5 min")
    single = fit_cost((200, 200), 1, FitChoices(beam="unknown"))
    assert single.text.startswith("one image of 200 × 200 px, unknown beam: about ")


def test_cost_of_a_large_image_is_shown_and_that_of_a_small_one_not() -> None:
    few = InversionOptions(n_sites=10_000)
    assert inversion_cost((500, 500), few).text == ""
    four = inversion_cost((2000, 2000), few)
    # Measured: 16 s of processor time, which two cores share.
    assert 16 / 2 < four.seconds < 16
    assert four.text == "4 Mpx with 10,000 sites: about 10 s and up to 1.3 GB."
    huge = inversion_cost((100_000, 100_000), few)
    assert huge.exceeds_memory
    assert "GB: crop or bin the image" in huge.text
