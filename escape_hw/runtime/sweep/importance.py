"""How much each parameter matters: functional analysis of variance over all loops (fANOVA)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.importance import FanovaImportanceEvaluator, get_param_importances
from optuna.trial import create_trial

from escape_hw.runtime.sweep.plan import EXPLORE, Arm
from escape_hw.runtime.sweep.space import Parameter
from escape_hw.runtime.sweep.store import Record

#: A parameter that does nothing: what it gets is what chance gives any.
CHANCE = "chance"
#: Fewer loops tell nothing of this.
LEAST = 20


def importances(
    records: Sequence[Record],
    arms: Sequence[Arm],
    space: Sequence[Parameter],
    seed: int,
    *,
    closed_only: bool = False,
) -> dict[str, float]:
    """Share of each parameter in the variance of the Strehl ratio (Hutter et al. 2014, by Optuna).

    The matrix counts as a parameter like any other (paper, validation procedure). Loops that diverged
    count with a Strehl ratio of 0, or not at all.

    Parameters
    ----------
    records
        Finished loops; those of the first stage are taken.
    arms, space, seed
        Of the sweep.
    closed_only
        Leave out the loops that diverged.

    Returns
    -------
    dict
        By parameter, with :data:`CHANCE`; sums to 1. Empty for fewer than :data:`LEAST` loops.
    """
    of = {arm.label: arm for arm in arms}
    mine = [r for r in records if r.slot.stage == EXPLORE and (r.merit > 0 or not closed_only)]
    if len(mine) < LEAST or np.ptp([record.merit for record in mine]) == 0:
        return {}
    distributions = {one.key: one.distribution() for one in space}
    distributions["matrix"] = CategoricalDistribution(tuple(dict.fromkeys(arm.matrix for arm in arms)))
    if len({arm.optical_gains for arm in arms}) > 1:
        distributions["optical_gains"] = CategoricalDistribution((False, True))
    distributions[CHANCE] = FloatDistribution(0.0, 1.0)
    known = {name: one for name, one in distributions.items() if not one.single()}
    chance = np.random.default_rng((seed, len(mine))).random(len(mine))
    study = optuna.create_study(direction="maximize")
    for record, nothing in zip(mine, chance, strict=True):
        arm = of[record.slot.arm]
        values = {
            **record.values, "matrix": arm.matrix, "optical_gains": arm.optical_gains, CHANCE: float(nothing)
        }  # fmt: skip
        params = {name: values[name] for name in known}
        study.add_trial(create_trial(params=params, distributions=known, value=record.merit))
    found = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=seed % 2**31))
    return {name: float(share) for name, share in found.items()}
