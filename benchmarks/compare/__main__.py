"""Compare solvers on one set of images: environments, images, runs, and docs/comparison.md.

    python benchmarks/compare [--quick] [--limit SECONDS] [--budget SECONDS] [--only WORD]

Any Python from 3.11 on starts it: it installs this package into an environment of its own and goes
on there. All of it stays in build/compare: environments, images and results, so that a second
run solves what the first has not. `--program` puts another program beside the solvers. `--page`
only writes the page and its plots from the results.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import json
import math
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

sys.path[:0] = [str(Path(__file__).parents[1])]

from compare.catalogue import ENVIRONMENTS, OURS, REPOSITORY, SOLVERS, Solver  # noqa: E402
from compare.environments import prepare  # noqa: E402

if TYPE_CHECKING:
    from compare.images import Case
    from compare.page import Results

BUILD = REPOSITORY / "build" / "compare"
PAGE = REPOSITORY / "docs" / "comparison.md"
RESULTS = REPOSITORY / "docs" / "pictures" / "comparison.json"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="benchmarks/compare", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="two images of 32² px, no page")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for an image")
    parser.add_argument("--memory", type=float, default=8.0, help="GiB for an image")
    parser.add_argument(
        "--budget", type=float, default=float("inf"), help="seconds for all images of a size"
    )
    parser.add_argument("--only", default="", help="solvers whose names have this word")
    parser.add_argument(
        "--program",
        default="",
        metavar="COMMAND",
        help="another program: it reads the text files {source} and {image} and writes "
        "{displacement}, such as 'octave --eval \"f('{source}', …)\"'",
    )
    parser.add_argument("--name", default="", help="of the other program in the page")
    parser.add_argument("--page", action="store_true", help="write the page from the results")
    return parser.parse_args(arguments)


def measure(chosen: argparse.Namespace, cases: list[Case], path: Path) -> Results:
    """Run all solvers and write the results after each image."""
    from compare.images import write_images
    from compare.runner import Limits, Worker, run

    results: Results = json.loads(path.read_text()) if path.exists() else {"solvers": {}}
    limits = Limits(chosen.limit, int(chosen.memory * 2**30), chosen.budget)
    results |= {
        "date": datetime.date.today().isoformat(),
        "processor": platform.machine(),
        "python": platform.python_version(),
        "runs": results.get("runs", 0) + 1,
        "limit_s": chosen.limit,
        "budget_s": chosen.budget if math.isfinite(chosen.budget) else None,
        "memory_gib": chosen.memory,
        "images": [
            {"key": case.key, "group": case.group, "name": case.name, "size": case.size}
            for case in cases
        ],
    }

    def save() -> None:
        path.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")

    write_images(BUILD / "images", cases)
    solvers = SOLVERS
    if chosen.program:
        os.environ["COMPARE_PROGRAM"] = chosen.program
        name = chosen.name or Path(shlex.split(chosen.program)[0]).name
        solvers = (Solver(name, "ours", "program", f"`{chosen.program}`"),)
    for solver in solvers:
        if chosen.only.lower() not in solver.name.lower():
            continue
        print(solver.name, flush=True)
        prepared = prepare(
            solver.environment, ENVIRONMENTS[solver.environment], BUILD / "environments"
        )
        entry = results["solvers"].setdefault(solver.name, {"images": {}})
        entry |= {"settings": solver.settings, "failure": prepared.failure, "note": prepared.note}
        if not prepared.failure:
            worker = Worker(prepared.python, solver.module, limits)
            run(worker, cases, entry["images"], BUILD, save)
            entry["version"] = worker.version or entry.get("version", "")
        save()
    return results


def main() -> None:
    chosen = parse()
    if not importlib.util.find_spec("napari_shadowinv"):
        ours = prepare("ours", ENVIRONMENTS["ours"], BUILD / "environments")
        if ours.failure:
            sys.exit(f"{OURS} does not install: {ours.failure}")
        command = [ours.python, str(Path(__file__).parent), *sys.argv[1:]]
        sys.exit(subprocess.run(command, env={**os.environ}).returncode)
    from compare.images import cases
    from compare.page import write_page

    BUILD.mkdir(parents=True, exist_ok=True)
    path = BUILD / ("quick.json" if chosen.quick else "results.json")
    if not chosen.page:
        measure(chosen, cases(chosen.quick), path)
    if not chosen.quick:
        results = path if path.exists() else RESULTS
        if results != RESULTS:
            RESULTS.write_text(results.read_text())
        write_page(json.loads(RESULTS.read_text()), PAGE)


if __name__ == "__main__":
    main()
