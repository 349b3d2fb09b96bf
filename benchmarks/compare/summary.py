"""Numbers of the page, all from the results: medians, counts of failures, comparisons."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from compare.catalogue import OURS

Results = dict[str, Any]
Result = dict[str, Any]

CLEARLY = 1.1  # a ratio; less is no difference
_MEGABYTE = 1e6
MIN_MEGABYTES = 0.1  # less is below what the system's pages resolve


@dataclass(frozen=True)
class Rival:
    """A solver against this package on the images that both solved."""

    name: str
    images: int
    error: float
    time: float
    memory: float
    smaller_error: int
    faster: int
    less_memory: int


def keys(
    results: Results, size: int | None = None, groups: Iterable[str] | None = None
) -> list[str]:
    """Keys of the images of a size and of some groups, in their order."""
    chosen = None if groups is None else set(groups)
    return [
        image["key"]
        for image in results["images"]
        if size in (None, image["size"]) and (chosen is None or image["group"] in chosen)
    ]


def sizes(results: Results) -> list[int]:
    return sorted({image["size"] for image in results["images"]})


def outcome(results: Results, solver: str, key: str) -> Result:
    entry = results["solvers"][solver]
    return dict(entry["images"].get(key, {"skipped": "not run"}))


def solved(results: Results, solver: str, chosen: Iterable[str]) -> dict[str, Result]:
    outcomes = {key: outcome(results, solver, key) for key in chosen}
    return {
        key: result
        for key, result in outcomes.items()
        if "failure" not in result and "skipped" not in result
    }


def seconds(result: Result) -> float:
    return max(float(result["processor_seconds"]), 1e-4)


def megabytes(result: Result) -> float:
    return max(float(result["memory_bytes"]) / _MEGABYTE, MIN_MEGABYTES)


def error(result: Result) -> float:
    return float(result["error_percent"])


def median(measure: Callable[[Result], float], results: Iterable[Result]) -> float | None:
    values = [measure(result) for result in results]
    return statistics.median(values) if values else None


def failures(results: Results, solver: str) -> dict[str, list[str]]:
    """Images that a solver failed at, by the name of the failure."""
    named: dict[str, list[str]] = {}
    for key in keys(results):
        if failure := outcome(results, solver, key).get("failure"):
            named.setdefault(failure, []).append(key)
    return named


def skipped(results: Results, solver: str) -> dict[str, list[str]]:
    """Images that a solver was not tried on, by the reason."""
    named: dict[str, list[str]] = {}
    for key in keys(results):
        if reason := outcome(results, solver, key).get("skipped"):
            named.setdefault(reason, []).append(key)
    return named


def rival(results: Results, solver: str) -> Rival | None:
    """Ratios of medians over common images, and on how many the solver is clearly better."""
    ours = solved(results, OURS, keys(results))
    theirs = solved(results, solver, ours)
    if not theirs:
        return None
    pairs = [(theirs[key], ours[key]) for key in theirs]

    def ratios(measure: Callable[[Result], float]) -> list[float]:
        return [measure(their) / measure(our) for their, our in pairs]

    errors, times, memories = (ratios(measure) for measure in (error, seconds, megabytes))
    better = [sum(ratio * CLEARLY < 1 for ratio in row) for row in (errors, times, memories)]
    return Rival(
        solver,
        len(pairs),
        statistics.median(errors),
        statistics.median(times),
        statistics.median(memories),
        *better,
    )
