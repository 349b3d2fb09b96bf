"""What a header promises against what its file can hold.

A damaged length must be refused before memory is asked for: `check_promise`. How much may be
asked for at all is another question: `napari_shadowinv._system.safety.check_size`.
"""

from __future__ import annotations

from pathlib import Path

from napari_shadowinv.errors import FileFormatError

__all__ = ["DEFLATE_RATIO", "check_promise"]

# The most that zlib can pack into one byte, a little rounded up.
DEFLATE_RATIO = 1040


def check_promise(path: Path, header: str, promised: int, held: int) -> None:
    """Refuse a file whose header promises more than it holds, before memory is asked for.

    Parameters
    ----------
    path : Path
        The file.
    header : str
        Name of the format, for the message.
    promised : int
        Bytes that the header tells.
    held : int
        Bytes that can be there at most.

    Raises
    ------
    FileFormatError
        If `promised` is more than `held`.
    """
    if promised > held:
        raise FileFormatError(
            f"{path} is damaged or truncated: its {header} header implies {promised} bytes, but "
            f"at most {held} are present; copy it again"
        )
