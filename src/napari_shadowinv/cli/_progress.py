"""The inversion, seen through progress bars and within reach of Ctrl-C."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from napari_shadowinv.cli._guard import interrupted
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    from rich.progress import TaskID

    from napari_shadowinv._system.progress import OnProgress, Progress
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.preprocessing import Radiograph, Recipe


def inverted(
    recipe: Recipe,
    shot: Radiograph,
    source: Radiograph | None = None,
    quiet: bool = False,
    **masks: Any,
) -> Inversion:
    """Apply a recipe to a shot; a mistake is told with the file's name."""
    from napari_shadowinv.pipeline import run

    with nullcontext() if quiet else progress_bars() as show:
        try:
            return run(
                recipe, shot, source=source, **masks, on_progress=show, should_stop=interrupted
            )
        except InputError as error:
            raise InputError(f"{shot.path}: {error}" if shot.path else str(error)) from error


@contextmanager
def progress_bars() -> Iterator[OnProgress | None]:
    """One bar for each stage, on a terminal only."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    columns = (
        TextColumn("{task.description:<10}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[message]}", style="dim", markup=False),
    )
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def finish_all() -> None:
            for task in tasks.values():
                bars.update(task, total=1, completed=1)
                bars.stop_task(task)

        def show(progress: Progress) -> None:
            if progress.stage not in tasks:
                finish_all()
                tasks[progress.stage] = bars.add_task(progress.stage, total=None, message="")
            bars.update(
                tasks[progress.stage],
                total=progress.total,
                completed=progress.step,
                message=progress.message,
            )

        yield show
        finish_all()
