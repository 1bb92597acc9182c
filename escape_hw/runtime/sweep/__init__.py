"""Sweeps over loop parameters and matrices: every matrix at its own best, compared on the same air."""
