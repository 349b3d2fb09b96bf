"""The figure of a planned experiment: `plan_figure`; its errors on given axes: `draw_errors`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from napari_shadowinv.facts import percent
from napari_shadowinv.physics.units import intensity_limits, shown_fields
from napari_shadowinv.pipeline.experiment_result import ExperimentPlan
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import LEVEL_COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plan_figure(plan: ExperimentPlan) -> Figure:
    """Show a plan on a page.

    Six panels: the image of the first draw, the field of the object and the one retrieved in the
    first draw, cuts through both along the dashed lines, the errors made and reported of all draws,
    and the parts of the reported error. The headline stands above the panels.
    """
    setup = plan.setups[0] if plan.setups else None
    true, retrieved = shown_fields([plan.truth, plan.retrieved], setup)
    with _panels.shot_page(plan.shape, setup, plan.title, plan.headline) as (figure, panels):
        image = plan.images[0] / plan.options.counts
        panels[0].draw_intensity(image, "First draw", intensity_limits(image))
        fields = {"object": true, "retrieved in the first draw": retrieved}
        _panels.draw_side_by_side(panels[1:4], fields)
        draw_errors(panels[4].axes, plan, "black")
        panels[4].axes.set_title(f"Error made: {percent(plan.error.median)}")
        _draw_parts(panels[5].axes, plan)
    return figure


def draw_errors(axes: Axes, plan: ExperimentPlan, ink: str = QUIET_COLOUR) -> None:
    """Draw the errors made and reported in each draw; the ink is the colour of those reported."""
    from matplotlib.ticker import MaxNLocator

    numbers = [shot.number for shot in plan.shots]
    colours = [LEVEL_COLOURS[shot.verdict.level] for shot in plan.shots]
    axes.bar(numbers, [100 * shot.error for shot in plan.shots], color=colours)
    totals = [100 * shot.total for shot in plan.shots]
    axes.plot(numbers, totals, "_", color=ink, markersize=7, label="reported")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("draw\n(blue: depends on the beam, orange: doubtful)")  # narrow, for a window
    axes.set_ylabel("error of the field (%)")
    axes.legend(fontsize=7)


def _draw_parts(axes: Axes, plan: ExperimentPlan) -> None:
    parts = plan.ranking[7::-1]
    if not parts:
        axes.axis("off")
        return
    axes.barh(
        [title for title, _ in parts], [100 * share for _, share in parts], color=QUIET_COLOUR
    )
    axes.set_xlabel("share of the field (%)")
    axes.set_title(f"Error reported: {percent(plan.total.median)}")
