"""``python -m sparsestreet`` is ``sparsestreet``."""

from sparsestreet.cli import main

if __name__ == "__main__":
    main()
