"""The whole ESCAPE method: DO-CRIME, SPRINT and the pseudo-synthetic interaction matrix, also from fewer frames than modes. The individual steps are in docrime and sprint."""
