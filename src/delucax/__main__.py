"""`python -m delucax demo`."""

import argparse
import sys


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m delucax", description="Differentiable control in JAX."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    demo = commands.add_parser(
        "demo", help="design, train, compare and show controllers for the pendulum"
    )
    demo.add_argument("--out", default="demo", help="folder to write to")
    demo.add_argument("--seeds", type=int, default=5, help="how many MLPs to train")
    options = parser.parse_args(arguments)
    try:
        from .experiments import demo as run

        run(options.out, seeds=options.seeds)
    except (OSError, ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
