"""How the source is laid out: who imports whom, what is said only once, how long a module is.

The facts are read from the source with `ast`, so that imports inside functions, for type checkers
only, and in the stubs of lazily loaded packages count like any other.
"""

from __future__ import annotations

import ast
import importlib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from helpers.sources import trees_of
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.preprocessing import ESTIMATES, STEPS

SOURCE = Path(__file__).parents[1] / "src"
PACKAGE = "napari_shadowinv"
# From the ground up: a room imports only rooms of the lines above its own.
ROOMS = (
    ("errors", "_typing", "cautions"),
    ("facts",),
    ("_system",),
    ("geometry",),
    ("physics",),
    ("options",),
    ("shot",),
    ("instrument",),
    ("preprocessing",),
    ("film",),
    ("provenance",),
    ("film_doses",),
    ("transport",),
    ("inversion",),
    ("fitting",),
    ("results",),
    ("analysis",),
    ("io",),
    ("pipeline",),
    ("stack", "plotting"),
    ("cli", "_napari"),
    ("", "__main__"),  # the package itself, with the public names, and the start of the command
)
HEIGHT = {room: height for height, rooms in enumerate(ROOMS) for room in rooms}
CORE = {room for room in HEIGHT if HEIGHT[room] < HEIGHT["io"]}
NEVER_IN_CORE = {"dask", "distributed", "matplotlib", "napari", "qtpy", "superqt", "typer"}
NOT_AT_ONCE_IN_CORE = {"xarray"}


def module_of(path: Path) -> str:
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


# A stub names what its package loads lazily.
FILES = [*sorted((SOURCE / PACKAGE).rglob("*.py")), *sorted((SOURCE / PACKAGE).rglob("*.pyi"))]
MODULES = {module_of(path) for path in FILES}


def imported(path: Path, nodes: Iterator[ast.AST]) -> Iterator[str]:
    """The modules that imports among some nodes of a file need."""
    package = module_of(path) if path.stem == "__init__" else module_of(path).rpartition(".")[0]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")
            above = above[: len(above) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                # Set before anything is imported, so that it may be asked for from anywhere.
                if (base, alias.name) == (PACKAGE, "__version__"):
                    continue
                name = f"{base}.{alias.name}"
                yield name if name in MODULES else base


def outside_functions(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that run when a module is imported, not those for type checkers."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from outside_functions(node)


def needs() -> dict[str, set[str]]:
    """Every module of the package, and those of the package that it imports."""
    imports: dict[str, set[str]] = {module: set() for module in MODULES}
    for path, tree in trees_of(FILES).items():
        names = imported(path, ast.walk(tree))
        imports[module_of(path)] |= {name for name in names if name.split(".")[0] == PACKAGE}
    return imports


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_every_room_has_its_place():
    assert {room_of(module) for module in MODULES} == set(HEIGHT)


def test_a_room_imports_only_rooms_below_it():
    above = [
        f"{module} imports {needed}"
        for module, imported_modules in needs().items()
        for needed in imported_modules
        if room_of(module) != room_of(needed) and HEIGHT[room_of(needed)] >= HEIGHT[room_of(module)]
    ]
    assert not above


def test_public_names_are_listed_in_packages_only():
    """In a module they are those without an underscore; the reference lists the phantoms."""
    listing = {path.stem for path in FILES if "__all__" in path.read_text(encoding="utf-8")}
    assert listing <= {"__init__", "phantoms"}


def test_modules_do_not_import_each_other_in_circles():
    try:
        TopologicalSorter(needs()).prepare()
    except CycleError as error:
        pytest.fail(f"circle: {' <- '.join(error.args[1])}")


@pytest.mark.parametrize("room", sorted(CORE))
def test_the_core_imports_no_window_no_cluster_no_figure(room):
    for path, tree in trees_of(FILES).items():
        if room_of(module_of(path)) != room:
            continue
        anywhere = {name.split(".")[0] for name in imported(path, ast.walk(tree))}
        assert not anywhere & NEVER_IN_CORE, path
        at_once = {name.split(".")[0] for name in imported(path, outside_functions(tree))}
        assert not at_once & NOT_AT_ONCE_IN_CORE, path


def test_only_one_module_connects_to_events_of_napari():
    places = [
        f"{path.name}:{node.lineno}"
        for path, tree in trees_of(FILES).items()
        if module_of(path) != f"{PACKAGE}._napari.viewer_sync"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr == "events"
    ]
    assert not places, "use connect of _napari/viewer_sync.py"


@cache
def classes_by_field() -> dict[str, list[str]]:
    """Classes that declare a field, by its name."""
    classes: dict[str, list[str]] = {}
    for tree in trees_of(FILES).values():
        for node in ast.walk(tree):
            for part in node.body if isinstance(node, ast.ClassDef) else ():
                if (
                    isinstance(part, ast.AnnAssign)
                    and isinstance(part.target, ast.Name)
                    and isinstance(part.value, ast.Call)
                    and "description" in {keyword.arg for keyword in part.value.keywords}
                ):
                    classes.setdefault(part.target.id, []).append(node.name)
    return classes


# Names for the same thing in a fit, where values and defaults differ.
OPTIONS_OF_FITS = {"boundary", "decay_length", "margin", "max_iterations"}
# One annotation for all models that have it.
SHARED_OPTIONS = {"max_error", "seed", "threads"}


@pytest.mark.parametrize("option", InversionOptions.model_fields)
def test_an_option_is_declared_once(option):
    step_parameters = {
        name for model in (*STEPS.values(), *ESTIMATES.values()) for name in model.parameters()
    }
    assert option not in step_parameters  # its flag would be that of a step
    of_fits = ["FitOptions"] if option in OPTIONS_OF_FITS else []
    expected = [] if option in SHARED_OPTIONS else [*of_fits, "InversionOptions"]
    assert sorted(classes_by_field().get(option, [])) == sorted(expected)


def names_declared() -> Counter[tuple[str, str]]:
    """Names of steps and sources, as a class declares them: ``step: Literal["bin"] = "bin"``."""
    return Counter(
        (part.target.id, ast.literal_eval(part.value))
        for tree in trees_of(FILES).values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        for part in node.body
        if isinstance(part, ast.AnnAssign)
        and isinstance(part.target, ast.Name)
        and part.target.id in ("step", "method")
        and isinstance(part.value, ast.Constant)
        and ast.unparse(part.annotation).startswith("Literal")
    )


def test_a_step_and_a_source_are_declared_once():
    steps = {("step", name): 1 for name in STEPS}
    sources = {("method", name): 1 for name in ("measured", *ESTIMATES)}
    assert names_declared() == steps | sources
    classes = Counter(
        node.name
        for tree in trees_of(FILES).values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    )
    assert {classes[model.__name__] for model in (*STEPS.values(), *ESTIMATES.values())} == {1}


def test_kernels_release_the_interpreter():
    """Otherwise a window freezes while another thread computes."""
    modules = {name for name in MODULES if name.split(".")[1:2] and name.split(".")[1] in CORE}
    kernels = [
        (module.__name__, name, value.targetoptions)
        for module in map(importlib.import_module, sorted(modules))
        for name, value in vars(module).items()
        if isinstance(value, Dispatcher)
    ]
    assert len(kernels) > 100
    assert [kernel[:2] for kernel in kernels if not kernel[2].get("nogil")] == []


RESULT_CLASSES = {"Inversion", "Fit", "FilmDoses", "RetrievedField", "ResultKind"}
MAX_DISPATCHES = 12


def dispatches_of(tree: ast.AST) -> Iterator[int]:
    """Lines that treat kinds of results differently: tests of a class or kind, and tables."""

    def names_result(*nodes: ast.AST) -> bool:
        names = {part.id for node in nodes for part in ast.walk(node) if isinstance(part, ast.Name)}
        return bool(names & RESULT_CLASSES)

    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
            if names_result(node.args[1]):
                yield node.lineno
        elif isinstance(node, ast.Compare):
            if names_result(node.left, *node.comparators):
                yield node.lineno
        elif isinstance(node, ast.Dict) and names_result(*filter(None, node.keys)):
            yield node.lineno


def test_few_places_treat_kinds_of_results_differently():
    places = [
        f"{path.name}:{line}"
        for path, tree in trees_of(FILES).items()
        for line in dispatches_of(tree)
    ]
    assert len(places) <= MAX_DISPATCHES, places
