"""Commands that calibrate, close the loop, track, sweep parameters or reproduce the paper."""
