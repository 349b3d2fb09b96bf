"""How many sites the shots of a stack get, where the accuracy decides: `choose_sites`."""

from __future__ import annotations

from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion import Inversion, count_sites
from napari_shadowinv.inversion.normalise import number_of_sites
from napari_shadowinv.stack._shots import Stack

TRIED, _INVERTED = 10, 3  # shots at the beginning of a stack


def choose_sites(stack: Stack, should_stop: ShouldStop | None = None) -> Stack:
    """Return the stack with the sites that its first shots need, if it has none yet.

    All shots that share a beam then share the sites. Shots that cannot be inverted decide nothing;
    without any other there are as many sites as without an accuracy.
    """
    if not stack.chooses_sites:
        return stack
    return with_chosen(stack, shares_needed(stack, should_stop))


def shares_needed(stack: Stack, should_stop: ShouldStop | None = None) -> list[float]:
    """Which share of the sites without an accuracy each of the first shots needs."""
    assert stack.beam is not None
    options = stack.recipe.options
    most = count_sites(stack.beam.image, options, mask=stack.beam.mask)
    work, needed = stack.work(()), []
    for shot in stack.shots.items[:TRIED]:
        try:
            content, _ = shot.load()
            inversion = work.invert(content, stack.beam, workers=1, should_stop=should_stop)
        except InversionCancelled:
            raise
        except Exception:  # whatever is wrong is told when its turn comes
            continue
        assert isinstance(inversion, Inversion)
        needed.append(inversion.report.n_sites / most)
        if len(needed) == _INVERTED:
            break
    return needed


def with_chosen(stack: Stack, shares: list[float]) -> Stack:
    """Return the stack with sites enough for each of these shares."""
    # A margin has its own sites, which are not counted here.
    most = number_of_sites(stack.shape, stack.recipe.options)
    return stack.with_sites(max(4, round(max(shares, default=1.0) * most)))
