"""The console script ``sb3-cchain``, also ``python -m sb3_cchain.zoo``."""

import sys


def main() -> None:
    """Run the command line; where RL Zoo is missing, say so in one line."""
    try:
        from sb3_cchain.zoo import cli
    except ImportError as error:
        sys.exit(f"sb3-cchain: {error}")
    cli.main()


if __name__ == "__main__":
    main()
