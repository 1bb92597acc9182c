"""Reproduction of the paper's tables and figures: experiments, products, and the numbers beside ours.

Figures of a single run are in ``escape_hw.report``.
"""
