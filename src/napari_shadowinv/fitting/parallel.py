"""Parts of a fit that run side by side: `run_in_parallel`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from threading import Lock
from typing import ParamSpec, TypeVar

from napari_shadowinv._system.machine import results_of

OnStep = Callable[[str, float], None]
"""Receives the stage and the objective after each step of a fit; an exception ends the fit."""

P = ParamSpec("P")
T = TypeVar("T")


def run_in_parallel(
    works: Sequence[Callable[[Callable[P, None]], T]], threads: int, on_step: Callable[P, None]
) -> list[T]:
    """Call functions side by side and return their results; their kernels share the threads.

    Their steps are reported one at a time. What ends one of them, such as an exception of
    `on_step`, ends the others at their next step, as does Ctrl-C.
    """
    causes: list[BaseException] = []
    reporting = Lock()

    def report(*args: P.args, **kwargs: P.kwargs) -> None:
        with reporting:
            if causes:
                raise causes[0]
            on_step(*args, **kwargs)

    def run(work: Callable[[Callable[P, None]], T]) -> T:
        try:
            return work(report)
        except BaseException as error:
            causes.append(error)
            raise

    try:
        return results_of([partial(run, work) for work in works], threads)
    except BaseException as error:
        causes.append(error)
        raise
