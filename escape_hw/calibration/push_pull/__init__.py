"""Interaction matrices measured mode by mode: push-pull, and modulation-demodulation.

Fast push-pull is a poke sequence of DO-CRIME (``acquisition.pokes``).
"""
