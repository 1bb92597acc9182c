"""SPRINT: registration and gain of mirror and sensor, and the pseudo-synthetic interaction matrix.

From the top: the fit to a matrix (``fit``) or to telemetry (``telemetry_fit``), its solvers (``solvers``,
``mixed_effects``, ``least_squares``) and their parts, diagnostics and the Cramer-Rao bound, and the matrix at
the fitted registration (``synthetic_matrix``). The estimation of interaction matrices is in ``docrime`` and
``push_pull``; following a registration in a running loop is in ``tracking``.
"""
