"""Figures of planned experiments: `plan_figure`, and of one quantity varied, `sweep_figure`.

- their errors on given axes: `draw_errors`
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.units import intensity_limits, shown_fields
from napari_shadowinv.pipeline.experiment_result import ExperimentPlan, ExperimentSweep
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import GOOD_COLOUR, LEVEL_COLOURS, QUIET_COLOUR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LOG_RANGE = 8.0  # of values; larger ones have a logarithmic axis


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


def sweep_figure(sweep: ExperimentSweep) -> Figure:
    """Show the error of a planned experiment as a curve over the quantity that is varied.

    The band holds 68 % of the draws; the dashed line is the error that is reported. Below stands
    the share of the draws whose field is determined.
    """
    with _panels.styled_figure((6.4, 4.8), layout="constrained") as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
        values, plans = _draw_sweep(above, sweep)
        above.legend()
        above.set_title(plans[0].title)
        shares = [100 * plan.determined_share for plan in plans]
        below.plot(values, shares, "s-", color=QUIET_COLOUR)
        below.set_ylim(-5, 105)
        below.set_ylabel("determined\n(% of draws)")
        below.set_xlabel(_axis_of(sweep))
    return figure


def draw_errors(
    axes: Axes, content: ExperimentPlan | ExperimentSweep, ink: str = QUIET_COLOUR
) -> None:
    """Draw the errors made and reported, of each draw of a plan or of each value of a sweep.

    The ink is the colour of the errors reported.
    """
    if isinstance(content, ExperimentSweep):
        _draw_sweep(axes, content, ink)
        axes.set_xlabel(_axis_of(content))
    else:
        _draw_draws(axes, content, ink)
    axes.legend(fontsize=7)


def _draw_sweep(
    axes: Axes, sweep: ExperimentSweep, ink: str = QUIET_COLOUR
) -> tuple[FloatArray, list[ExperimentPlan]]:
    """Draw the errors over the values; return these in their order, and the plans."""
    order = np.argsort(sweep.values)
    values = np.array(sweep.values)[order]
    plans = [sweep.plans[k] for k in order]
    spreads = [plan.error for plan in plans]
    low, high = ([100 * getattr(each, end) for each in spreads] for end in ("low", "high"))
    axes.fill_between(values, low, high, color=GOOD_COLOUR, alpha=0.2, label="68 % of the draws")
    medians = [100 * each.median for each in spreads]
    axes.plot(values, medians, "o-", color=GOOD_COLOUR, label="error made")
    totals = [100 * plan.total.median for plan in plans]
    axes.plot(values, totals, "--", color=ink, label="error reported")
    axes.set_ylabel("error of the field (%, r.m.s.)")
    axes.set_ylim(bottom=0)
    if values[0] > 0 and values[-1] / values[0] > _LOG_RANGE:
        axes.set_xscale("log")
        axes.minorticks_off()
    axes.set_xticks(values, [f"{value:.4g}" for value in values])
    return values, plans


def _axis_of(sweep: ExperimentSweep) -> str:
    return f"{sweep.title} ({sweep.unit})" if sweep.unit else sweep.title


def _draw_draws(axes: Axes, plan: ExperimentPlan, ink: str) -> None:
    """Errors made and reported in each draw; draws that are not determined in another colour."""
    from matplotlib.ticker import MaxNLocator

    numbers = [shot.number for shot in plan.shots]
    colours = [LEVEL_COLOURS[shot.verdict.level] for shot in plan.shots]
    axes.bar(numbers, [100 * shot.error for shot in plan.shots], color=colours)
    totals = [100 * shot.total for shot in plan.shots]
    axes.plot(numbers, totals, "_", color=ink, markersize=7, label="reported")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("draw (blue: depends on the beam, orange: doubtful)")
    axes.set_ylabel("error of the field (%)")


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
