"""Planned experiments: time, and errors against independent simulations: docs/planning.md.

    python benchmarks/planning.py [times repeats searches counts] [--draws 20] [--side 200]

Times: plans of two energies, side × side px, by wall and by processor time. On a machine that does
other work, too, half of the processor time is what two idle cores would need at least.
Repeats: the median error of a plan, and of as many shots of the same object and instrument that
`instrument.py` simulates by counted rays, without the package's forward model; errors over totals.
Searches: errors of the same draws by fits near the true field, and by full fits.
Counts: the median error of a weak object that only noise disturbs; it falls as the root of counts.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from instrument import COUNTS, IMPERFECTIONS, Shot, objects, truth
from napari_shadowinv import Instrument, ProtonSetup, invert
from napari_shadowinv.physics.phantom_models import BlobRecipe, ToroidRecipe
from napari_shadowinv.pipeline import ExperimentOptions, plan_experiment
from napari_shadowinv.pipeline.experiment_object import object_of_displacement

INSTRUMENTS = {
    "noise only": Instrument(beam_rms=0.0),
    "beam stated to 2 %": Instrument(beam_rms=0.02),
    "camera, implosion": Instrument(detector="camera", beam_source="implosion"),
}


def setups() -> list:
    first = ProtonSetup.example()
    return [first, first.model_copy(update={"energy": 30.0})]


def table_of_times(draws: int, side: int) -> None:
    print(f"| instrument, {draws} draws of {side}² px, two energies | wall | CPU | error | total |")
    print("|---|---|---|---|---|")
    warm = ExperimentOptions(draws=2)
    plan_experiment(ToroidRecipe(), setups(), shape=(64, 64), options=warm)
    for title, instrument in INSTRUMENTS.items():
        wall, cpu = time.perf_counter(), time.process_time()
        plan = plan_experiment(
            ToroidRecipe(peak=60),
            setups(),
            shape=(side, side),
            instrument=instrument,
            options=ExperimentOptions(draws=draws),
        )
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(
            f"| {title} | {wall:.0f} s | {cpu:.0f} s | {plan.error.median:.2%} "
            f"({plan.error.low:.2%} to {plan.error.high:.2%}) | {plan.total.median:.2%} |",
            flush=True,
        )
    print()


def table_of_repeats(draws: int, side: int) -> None:
    print(f"| imperfection, {draws} draws | error planned | error of repeats | total planned |")
    print("|---|---|---|---|")
    for title, change in IMPERFECTIONS.items():
        if title.startswith("registration"):
            continue
        shape = "ellipses"
        exact = truth(side, shape)
        errors, instrument = [], Instrument()
        for number in range(draws):
            shot = Shot(side, objects(side)[shape], 1000 + number)
            change(shot)
            instrument = shot.instrument
            inversion = invert(shot.image(), source=COUNTS * shot.source, instrument=instrument)
            error = np.linalg.norm(inversion.displacement - exact) / np.linalg.norm(exact)
            errors.append(error)
        # The repeats take a uniform source as recorded, without noise.
        stated = instrument.model_copy(update={"beam_rms": instrument.beam_rms or 0.0})
        plan = plan_experiment(
            object_of_displacement(exact),
            instrument=stated,
            options=ExperimentOptions(
                counts=COUNTS, draws=draws, reference="recorded", reference_counts=1e9
            ),
        )
        low, high = np.quantile(errors, (0.16, 0.84))
        print(
            f"| {title} | {plan.error.median:.1%} ({plan.error.low:.1%} to {plan.error.high:.1%}) "
            f"| {np.median(errors):.1%} ({low:.1%} to {high:.1%}) | {plan.total.median:.1%} |",
            flush=True,
        )
    print()


def table_of_searches(draws: int, side: int) -> None:
    """Print errors of the same draws by the fits of a plan and by full ones."""
    chosen = ToroidRecipe(peak=60, radius=side * 1.5e-6 / 8)
    print(f"| instrument, {draws} draws of {side}² px | near | full fit |")
    print("|---|---|---|")
    for title, instrument in INSTRUMENTS.items():
        rows = []
        for searched in (1, draws):
            options = ExperimentOptions(draws=draws, searched=searched)
            plan = plan_experiment(
                chosen, setups(), shape=(side, side), instrument=instrument, options=options
            )
            rows.append([shot.error for shot in plan.shots[1:]])
        listed = [", ".join(f"{error:.1%}" for error in row) for row in rows]
        print(f"| {title} | {' | '.join(listed)} |", flush=True)
    print()


def table_of_counts(draws: int, side: int) -> None:
    counts = [100, 400, 1600, 6400]
    print("| counts a pixel | error made | reported | error × √counts |")
    print("|---|---|---|---|")
    for count in counts:
        plan = plan_experiment(
            BlobRecipe(amplitude=15, sigma=side / 12),
            shape=(side, side),
            instrument=Instrument(beam_rms=0.0),
            options=ExperimentOptions(draws=draws, counts=count),
        )
        scaled = plan.error.median * np.sqrt(count)
        print(f"| {count} | {plan.error.median:.2%} | {plan.total.median:.2%} | {scaled:.3f} |")
    print()


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    names = ["times", "repeats", "searches", "counts"]
    parser.add_argument(
        "tables", nargs="*", default=names, help="of times, repeats, searches, counts"
    )
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--side", type=int, default=200)
    chosen = parser.parse_args()
    if "times" in chosen.tables:
        table_of_times(chosen.draws, chosen.side)
    if "repeats" in chosen.tables:
        table_of_repeats(chosen.draws, 100)
    if "searches" in chosen.tables:
        table_of_searches(min(chosen.draws, 5), 96)
    if "counts" in chosen.tables:
        table_of_counts(chosen.draws, 100)


if __name__ == "__main__":
    main()
