"""Simulated deformable mirrors: influence functions, surfaces, flexure, dynamics, the shell."""
