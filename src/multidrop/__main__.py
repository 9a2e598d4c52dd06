"""The command `multidrop`, and `python -m multidrop`."""

import sys


def main() -> int:
    """Run the command line; return its exit code. Ctrl-C during the imports prints only one sentence."""
    try:
        from multidrop.cli import main
    except (KeyboardInterrupt, RuntimeError) as interruption:
        if not isinstance(interruption.__cause__ or interruption, KeyboardInterrupt):
            raise  # not Ctrl-C: inside a class statement, Python turns Ctrl-C into a RuntimeError
        print("multidrop: interrupted", file=sys.stderr)
        return 130
    return main()


if __name__ == "__main__":
    sys.exit(main())
