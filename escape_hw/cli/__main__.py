"""``python -m escape_hw.cli`` is ``escape``."""

from escape_hw.cli import main

if __name__ == "__main__":
    main()
