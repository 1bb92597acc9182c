"""Simulated optics and detectors: the sampled pupil, Shack-Hartmann and pyramid sensors, modulation, focal plane, detector noise. OOPAO's versions are in oopao/; the linearised models in models/."""
