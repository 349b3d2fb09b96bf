"""The command `shadowinv`, also as ``python -m napari_shadowinv``."""

import sys


def main() -> None:
    """Run the command; Ctrl-C ends it with one word even before it is loaded."""
    try:
        from napari_shadowinv.cli import app
    except KeyboardInterrupt:
        sys.stderr.write("Cancelled\n")
        sys.exit(130)
    app()


if __name__ == "__main__":
    main()
