"""The trees of source files, each parsed once by a process, and only if a test asks for it."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def trees_of(paths: list[Path]) -> dict[Path, ast.Module]:
    return {path: tree_of(path) for path in paths}
