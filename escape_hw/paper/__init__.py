"""Reproduction of the paper's tables and figures: experiments, products, and the numbers beside ours."""
