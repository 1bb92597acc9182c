"""The whole ESCAPE method: DO-CRIME, SPRINT and the pseudo-synthetic interaction matrix.

``short_runs`` covers runs of fewer frames than an interaction matrix takes. The steps are in ``docrime`` and
``sprint``.
"""
