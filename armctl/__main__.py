"""The command line: `armctl`, or `python -m armctl`."""

import sys


def main() -> int:
    """Run one command; `stop` without the time that the others take to be imported."""
    try:
        from armctl.client.stop import typed

        if (status := typed(sys.argv[1:])) is not None:
            return status
        from armctl.cli import main

        return main()
    except KeyboardInterrupt:  # while it was imported
        return 130


if __name__ == "__main__":
    sys.exit(main())
