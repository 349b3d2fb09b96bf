from __future__ import annotations

from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real and reference images that live beside the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"reference images are not at {SHARED_DATA}")
    return SHARED_DATA
