"""Reproduction of the paper: its experiments as procedures, their criteria and products, the campaign of registration error against frames, and the table of the paper's numbers beside ours."""
