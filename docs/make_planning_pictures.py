"""Make the picture of docs/planning.md, and print its numbers.

python docs/make_planning_pictures.py
"""

from __future__ import annotations

from pathlib import Path

from napari_shadowinv import Instrument, ProtonSetup
from napari_shadowinv.physics.phantom_models import ToroidRecipe
from napari_shadowinv.pipeline import ExperimentOptions, plan_experiment
from napari_shadowinv.plotting import plan_figure, save_figure

FOLDER = Path(__file__).parent
OBJECT = ToroidRecipe(peak=60, radius=20e-6)
SHAPE = (128, 128)
INSTRUMENT = Instrument(beam_rms=0.01, background=0.03, blur=1.0, energy=0.03)


def main() -> None:
    """Plan one shot of the paper's protons."""
    options = ExperimentOptions()
    plan = plan_experiment(
        OBJECT, ProtonSetup.example(), shape=SHAPE, instrument=INSTRUMENT, options=options
    )
    print(plan.headline.text)
    print("\n".join(f"{fact.title}: {fact.text}" for fact in plan.facts))
    save_figure(FOLDER / "planning.png", plan_figure(plan), overwrite=True)


if __name__ == "__main__":
    main()
