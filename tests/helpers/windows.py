"""Windows of the plugin: when they are at rest."""

import threading

PATIENCE = 120_000  # ms; a machine may have other things to do


def at_rest(tool):
    """Whether no work of a window runs, and all layers of its results are there."""
    views = (getattr(tool, name, None) for name in ("results", "stack_view", "fit_images"))
    return not (tool.panel.running or any(view is not None and view.busy for view in views))


def running_threads():
    """Names of the threads of the plugin's work and of the shots of a run."""
    names = [thread.name for thread in threading.enumerate()]
    return [name for name in names if name.startswith(("shot", "shadowinv"))]
