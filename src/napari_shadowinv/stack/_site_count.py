"""Number of sites of a stack from the accuracy: `choose_sites`."""

from __future__ import annotations

from typing import cast

from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion import Inversion, count_sites
from napari_shadowinv.inversion.normalise import number_of_sites
from napari_shadowinv.stack._shots import Stack

MAX_TRIED_SHOTS = 10  # at the beginning of a stack
_DECIDING_SHOTS = 3


def choose_sites(stack: Stack, should_stop: ShouldStop | None = None) -> Stack:
    """Return the stack with the number of sites that its first shots need.

    All shots that share a beam then share the sites. Shots that cannot be inverted are skipped; if
    all of them are, the number is the default without an accuracy.
    """
    if not stack.chooses_sites:
        return stack
    return with_enough_sites(stack, needed_shares(stack, should_stop))


def needed_shares(stack: Stack, should_stop: ShouldStop | None = None) -> list[float]:
    """Return the share of the default number of sites that each of the first shots needs."""
    assert stack.beam is not None
    options = stack.recipe.options
    most = count_sites(stack.beam.image, options, mask=stack.beam.mask)
    work, needed = stack.work(()), []
    for shot in stack.shots.items[:MAX_TRIED_SHOTS]:
        try:
            content, _ = shot.load()
            inversion = work.invert(content, stack.beam, workers=1, should_stop=should_stop)
        except InversionCancelled:
            raise
        except Exception:  # the error is reported when it is its turn
            continue
        needed.append(cast("Inversion", inversion).report.n_sites / most)
        if len(needed) == _DECIDING_SHOTS:
            break
    return needed


def with_enough_sites(stack: Stack, shares: list[float]) -> Stack:
    """Return the stack with enough sites for each of these shares."""
    # A margin has its own sites, which are not counted here.
    most = number_of_sites(stack.shape, stack.recipe.options)
    return stack.with_sites(max(4, round(max(shares, default=1.0) * most)))
