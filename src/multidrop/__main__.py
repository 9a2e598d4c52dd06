"""The command `multidrop`, and `python -m multidrop`."""

import sys


def main() -> int:
    """Run the command line. Ctrl-C ends it with a sentence, also while its modules are being imported."""
    try:
        from multidrop.cli import main
    except (KeyboardInterrupt, RuntimeError) as interruption:
        if not isinstance(interruption.__cause__ or interruption, KeyboardInterrupt):
            raise  # Python wraps only an interruption of a class statement
        print("multidrop: interrupted", file=sys.stderr)
        return 130
    return main()


if __name__ == "__main__":
    sys.exit(main())
