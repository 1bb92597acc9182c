"""Reproduction of the paper's tables and figures: experiments, their products, and the numbers beside ours."""
