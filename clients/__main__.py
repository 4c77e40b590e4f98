"""Where the command line begins: a Ctrl-C while it is still being imported ends it as quietly as a later one."""

from __future__ import annotations

import signal
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line; the console script `straightpcf`."""
    # Until somebody else takes it: the first process of a container is not told of signals that nobody handles.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from straightpcf.clients import cli
    except KeyboardInterrupt:
        sys.exit(130)
    cli.main()


if __name__ == "__main__":
    main()
