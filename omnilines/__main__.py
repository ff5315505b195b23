"""Entry point of the `omnilines` command, and of `python -m omnilines`."""

import os
import sys


def main() -> None:
    """`omnilines.cli.main`; Ctrl-C is heard while that is imported too."""
    try:
        from omnilines.cli import main as command
    except KeyboardInterrupt:
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, b"omnilines: stopped.\n")
        os._exit(130)
    command()


if __name__ == "__main__":
    main()
