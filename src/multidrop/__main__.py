"""The command `multidrop`, and `python -m multidrop`."""

import sys


def main() -> int:
    """Run the command line; return its exit code. Ctrl-C during the imports prints only one sentence."""
    try:
        from multidrop.cli import main
    except (KeyboardInterrupt, RuntimeError) as interruption:
        # Ctrl-C in a class statement may raise a RuntimeError; its cause is then the KeyboardInterrupt.
        if not isinstance(interruption.__cause__ or interruption, KeyboardInterrupt):
            raise
        print("multidrop: interrupted", file=sys.stderr)
        return 130
    return main()


if __name__ == "__main__":
    sys.exit(main())
