"""The page docs/comparison.md; every number of a measurement comes from the results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from compare import summary
from compare.catalogue import EXACT, KASIM, LEFT_OUT, LINEAR, OURS, PUBLISHED, SOLVERS, STAND_IN
from compare.densities import CLASSES
from compare.plots import draw_scaling, draw_trade_off
from compare.runner import OUT_OF_MEMORY, OUT_OF_TIME
from compare.summary import Result, Results

_BRIEF = {
    OUT_OF_TIME: "time",
    OUT_OF_MEMORY: "memory",
    "not finite": "not finite",
    "diverged": "diverged",
}
_HEADS = {
    "ours": "this package",
    "ours_exact": "accuracy 0.001",
    "ours_free": "free boundary",
    "ours_lbfgs": "L-BFGS",
    "poisson": "Poisson",
    "grid_monge_ampere": "grid MA",
    "sunbear_package": "sunbear",
    "pysdot_package": "pysdot",
    "sdot_package": "sdot",
    "pot_exact": "POT exact",
    "pot_sinkhorn": "POT",
    "ott_sinkhorn": "OTT",
    "geomloss_sinkhorn": "geomloss",
    "multiscaleot_package": "MultiScaleOT",
}
_FEW = 10  # images that a solver must have solved to be named as the fastest, or most exact
_TRADE_OFF, _SCALING = "comparison.png", "comparison-scaling.png"

TEMPLATE = Path(__file__).with_name("template.md")


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def short(value: float | None, digits: int = 2) -> str:
    """Value with some significant digits, without an exponent."""
    if value is None:
        return "–"
    if float(f"{value:.{digits}g}") >= 10**digits:
        return f"{value:,.0f}"
    return f"{value:#.{digits}g}".rstrip(".")


def installed(results: Results) -> list[str]:
    """Names of the solvers that were run, in the catalogue's order, then any others."""
    entries = results["solvers"]
    order = [solver.name for solver in SOLVERS if solver.name in entries]
    order += [name for name in entries if name not in order]
    return [name for name in order if not entries[name].get("failure")]


def head_of(name: str) -> str:
    modules = {solver.name: solver.module for solver in SOLVERS}
    return _HEADS.get(modules.get(name, ""), name)


def summary_table(results: Results) -> str:
    sizes = summary.sizes(results)[:2]
    rows = []
    for name in installed(results):
        row = [name]
        for size in sizes:
            chosen = summary.keys(results, size)
            successes = summary.solved(results, name, chosen)
            untried = [key for key in chosen if "skipped" in summary.outcome(results, name, key)]
            row.append(f"{len(successes)} of {len(chosen) - len(untried)}")
            measures = (summary.error, summary.seconds, summary.megabytes)
            middles = [summary.median(measure, successes.values()) for measure in measures]
            row += [short(middle) for middle in middles]
        largest = max((image["size"] for image in results["images"]
                       if summary.solved(results, name, [image["key"]])), default=None)  # fmt: skip
        rows.append([*row, f"{largest}²" if largest else "–"])
    columns = [f"{size}²: {what}" for size in sizes for what in ("solved", "error, %", "s", "MB")]
    return table(["solver", *columns, "largest solved, px"], rows)


def cell(result: Result) -> str:
    if "skipped" in result:
        return "–"
    if failure := result.get("failure"):
        return f"*{_BRIEF.get(failure, 'error')}*"
    return short(summary.error(result))


def error_table(results: Results, chosen: list[str]) -> str:
    """Errors of the solvers that solved at least one of the chosen images."""
    names = [name for name in installed(results) if summary.solved(results, name, chosen)]
    rows = []
    for key in chosen:
        successes = {name: summary.solved(results, name, [key]) for name in names}
        errors = {name: summary.error(one[key]) for name, one in successes.items() if one}
        best = short(min(errors.values())) if errors else ""
        cells = [cell(summary.outcome(results, name, key)) for name in names]
        rows.append([key, *(f"**{text}**" if text == best else text for text in cells)])
    return table(["image", *(head_of(name) for name in names)], rows)


def peaks(results: Results) -> str:
    """Sentence about this package on the peaks, with its largest error and time."""
    chosen = [key for key in summary.keys(results, groups=["hard"]) if key.startswith("peak")]
    successes = summary.solved(results, OURS, chosen)
    if not successes:
        return "This package solved none of the peaks."
    worst = max(successes, key=lambda key: summary.error(successes[key]))
    slowest = max(successes, key=lambda key: summary.seconds(successes[key]))
    return (
        f"This package solves {len(successes)} of the {len(chosen)} peaks: its largest error is "
        f"{short(summary.error(successes[worst]))} % ({worst} px), its longest time "
        f"{short(summary.seconds(successes[slowest]))} s ({slowest} px)."
    )


def choice(results: Results) -> str:
    """Three sentences: which solver for which image."""
    ours = summary.solved(results, OURS, summary.keys(results))
    names = [name for name in installed(results) if not name.startswith(OURS)]
    rivals = [each for name in names if (each := summary.rival(results, name))]
    nonlinear = [each for each in rivals if each.name != LINEAR and each.images >= _FEW]
    fastest = min(nonlinear, key=lambda each: each.time)
    exact = max(nonlinear, key=lambda each: each.smaller_error / each.images)
    shared = summary.solved(results, EXACT, summary.solved(results, exact.name, ours))
    theirs = summary.solved(results, exact.name, shared)
    wins = sum(
        summary.error(theirs[key]) * summary.CLEARLY < summary.error(shared[key]) for key in shared
    )
    return (
        f"**Any image**: this package solves {len(ours)} of {len(summary.keys(results))} by its "
        f"defaults, and the fastest other nonlinear solver, {fastest.name}, takes "
        f"{short(fastest.time)} times its time.\n"
        f"**The smallest error, without noise**: this package with `accuracy=0.001`; {exact.name} "
        f"is better by a tenth on {wins} of {len(shared)} images, and on {exact.smaller_error} of "
        f"{exact.images} than the defaults.\n"
        "**Weak modulations, or a first look**: Poisson, in a hundredth of the time, but wrong by "
        "tens of per cent as soon as the modulation is strong."
    )


def verdict(results: Results) -> str:
    """Sentences on the time of the solver of 2017 and of the stand-in, on common images."""
    sentences = []
    for name in (KASIM, STAND_IN):
        if name in results["solvers"] and (rival := summary.rival(results, name)):
            failed = sum(len(images) for images in summary.failures(results, name).values())
            sentences.append(
                f"- {name}: {short(rival.time)} times the time, {short(rival.memory)} times the "
                f"memory and {short(rival.error)} times the error of this package, as medians over "
                f"the {rival.images} images that both solved; failures: {failed}."
            )
    return "\n".join(sentences)


def rival_table(results: Results) -> str:
    rivals = [summary.rival(results, name) for name in installed(results) if name != OURS]
    rows = [
        [
            rival.name,
            str(rival.images),
            short(rival.error),
            short(rival.time),
            short(rival.memory),
            str(rival.smaller_error),
            str(rival.faster),
            str(rival.less_memory),
        ]
        for rival in rivals
        if rival
    ]
    head = ["solver", "images", "error ratio", "time ratio", "memory ratio"]
    return table([*head, "smaller error", "faster", "less memory"], rows)


def better(results: Results) -> str:
    """Sentences on the solvers that are better on most images, and on the smallest errors."""
    lines = []
    for name in installed(results):
        rival = summary.rival(results, name) if name != OURS else None
        if rival is None:
            continue
        counts = {
            "a smaller error": rival.smaller_error,
            "less time": rival.faster,
            "less memory": rival.less_memory,
        }
        merits = [
            f"{merit} on {count}" for merit, count in counts.items() if 2 * count > rival.images
        ]
        if merits:
            lines.append(f"- {name}: {', '.join(merits)} of {rival.images} images.")
    smallest = Counter[str]()
    for key in summary.keys(results):
        errors = {
            name: summary.error(solved[key])
            for name in installed(results)
            if (solved := summary.solved(results, name, [key]))
        }
        if errors:
            smallest[min(errors, key=lambda name: errors[name])] += 1
    ranks = ", ".join(f"{name} {count}" for name, count in smallest.most_common())
    return "\n".join(
        [
            "Better than the default options of this package on most images:",
            "",
            *lines,
            "",
            f"The smallest error of all solvers, by the number of images: {ranks}.",
        ]
    )


def settings_table(results: Results) -> str:
    rows = []
    for name in installed(results):
        entry = results["solvers"][name]
        rows.append([name, entry.get("version") or "–", entry.get("settings", "")])
    return table(["solver", "version", "settings"], rows)


def not_installed(results: Results) -> str:
    lines = []
    for name, entry in results["solvers"].items():
        if failure := entry.get("failure"):
            lines.append(f"- **{name}** does not install: {failure}.")
        elif note := entry.get("note"):
            lines.append(
                f"- **{name}**: the newest version does not install ({note}); the newest that has "
                f"a wheel, {entry.get('version')}, was run."
            )
    return "\n".join(["What did not install:", "", *lines]) if lines else ""


def render(results: Results) -> str:
    budget = results.get("budget_s")
    flags = f" --limit {results['limit_s']:g}" + (f" --budget {budget:g}" if budget else "")
    return TEMPLATE.read_text(encoding="utf-8").format(
        **{name: results[name] for name in ("date", "processor", "limit_s", "memory_gib")},
        flags=flags,
        budget=f", and {budget:g} s for all images of a size in a run" if budget else "",
        runs=results["runs"],
        remarks="".join(f"{remark}\n" for remark in results.get("remarks", [])),
        summary=summary_table(results),
        verdict=verdict(results),
        peaks=peaks(results),
        hard=error_table(results, summary.keys(results, groups=["hard"])),
        rivals=rival_table(results),
        better=better(results),
        choice=choice(results),
        classes="\n".join(f"  - `{name}`: {text}" for name, text in CLASSES.items()),
        settings=settings_table(results),
        not_installed=not_installed(results),
        left_out="\n".join(f"- **{name}**: {reason}." for name, reason in LEFT_OUT.items()),
        published=table(["code", "stated", "where"], PUBLISHED),
    )


def write_page(results: Results, page: Path) -> None:
    """Write the page, and its plots into the folder `pictures` beside it."""
    pictures = page.parent / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    draw_trade_off(results, pictures / _TRADE_OFF, tuple(summary.sizes(results)[:2]))
    draw_scaling(results, pictures / _SCALING)
    page.write_text(render(results), encoding="utf-8")
