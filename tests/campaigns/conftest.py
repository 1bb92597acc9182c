"""Seeded attempts to break what the documentation promises; ``pytest -m campaign`` runs them."""

from campaign_table import campaign
from process_fixtures import environment, escape, im, start, system

__all__ = ["campaign", "environment", "escape", "im", "start", "system"]
