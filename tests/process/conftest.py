"""Real ``escape`` processes on a small twin."""

from process_fixtures import environment, escape, im, start, system

__all__ = ["environment", "escape", "im", "start", "system"]
