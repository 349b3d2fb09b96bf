"""The command `shadowinv`, also as ``python -m napari_shadowinv``."""

import gc
import sys


def main() -> None:
    """Run the command; Ctrl-C ends it with one word even before it is loaded."""
    gc.disable()  # what is being loaded stays, so searching it for garbage takes time in vain
    try:
        from napari_shadowinv.cli import app
    except KeyboardInterrupt:
        sys.stderr.write("Cancelled\n")
        sys.exit(130)
    gc.freeze()
    gc.enable()
    app()


if __name__ == "__main__":
    main()
