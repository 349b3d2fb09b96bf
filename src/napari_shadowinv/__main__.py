"""The command `shadowinv`, also as ``python -m napari_shadowinv``."""

import os
import signal
import sys
from typing import NoReturn


def main() -> None:
    """Run the command; Ctrl-C ends it with one word even before it is loaded."""
    heeds_ctrl_c = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heeds_ctrl_c:
        signal.signal(signal.SIGINT, _cancel)
    from napari_shadowinv.cli import app

    try:
        app()
    finally:
        if heeds_ctrl_c:  # what a command has written is not cancelled
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _cancel(*_: object) -> NoReturn:
    """End before a command has begun, at once: libraries may swallow a KeyboardInterrupt."""
    sys.stderr.write("Cancelled\n")
    sys.stderr.flush()
    os._exit(130)


if __name__ == "__main__":
    main()
