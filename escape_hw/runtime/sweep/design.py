"""Which loops a sweep runs: arms, stages, slots, and the air of each."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from escape_hw.runtime.sweep.search_space import Parameter

#: The stages in their order: parameters drawn; the best few of each arm on common air; the winner of each
#: arm on fresh common air.
EXPLORE, SHORTLIST, FINAL = "explore", "shortlist", "final"
STAGES = (EXPLORE, SHORTLIST, FINAL)
#: Spacing of the stages' seeds.
_SEED_SPACING = 1_000_000


@dataclass(frozen=True, slots=True)
class MatrixVariant:
    """One of the matrices to compare.

    Parameters
    ----------
    matrix
        How the matrix is called.
    optical_gains
        Whether it is scaled by its optical gains.
    path
        Its file.
    sha256
        The file's checksum.
    """

    matrix: str
    optical_gains: bool
    path: Path
    sha256: str

    @property
    def label(self) -> str:
        """Name of the arm."""
        return f"{self.matrix} + OG" if self.optical_gains else self.matrix


@dataclass(frozen=True, slots=True)
class Slot:
    """Place of one loop in the plan.

    Parameters
    ----------
    stage
        One of :data:`STAGES`.
    arm
        Label of the arm.
    index
        Number of the air: the same for every arm, and every candidate.
    candidate
        Number of the parameters, in the later stages.
    """

    stage: str
    arm: str
    index: int
    candidate: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def run_seed(self, seed: int) -> int:
        """Seed of the air and the noise: no two stages share any."""
        return seed + _SEED_SPACING * (1 + STAGES.index(self.stage)) + self.index


@dataclass(frozen=True, slots=True)
class Design:
    """How many loops there are.

    Parameters
    ----------
    trials
        Loops of the first stage over all arms.
    candidates, heats
        How many parameters of each arm run again, and on how many stretches of air.
    finals
        Stretches of air that the best of each arm run on.
    """

    trials: int = 200
    candidates: int = 3
    heats: int = 4
    finals: int = 20

    def exploration_slots(self, arms: Sequence[MatrixVariant]) -> Iterator[Slot]:
        """Slots of the first stage: air by air, every arm on each."""
        for number in range(self.trials):
            yield Slot(EXPLORE, arms[number % len(arms)].label, number // len(arms))

    def shortlist_slots(self, arms: Sequence[MatrixVariant]) -> Iterator[Slot]:
        """Slots of the second stage."""
        for index in range(self.heats):
            for arm in arms:
                for candidate in range(self.candidates):
                    yield Slot(SHORTLIST, arm.label, index, candidate)

    def final_slots(self, arms: Sequence[MatrixVariant]) -> Iterator[Slot]:
        """Slots of the last stage."""
        for index in range(self.finals):
            for arm in arms:
                yield Slot(FINAL, arm.label, index)

    def n_loops(self, n_variants: int) -> int:
        """All loops."""
        return self.trials + n_variants * (self.candidates * self.heats + self.finals)


def draw_parameters(space: Sequence[Parameter], seed: int, index: int) -> dict[str, Any]:
    """Random parameters of a stretch of air: a function of its number alone.

    So every arm gets the same ones, in whatever order and on whatever machine its loop runs.
    """
    values = {}
    for one in space:
        own = (seed, index, zlib.crc32(one.key.encode()))
        values[one.key] = one.at(float(np.random.default_rng(own).random()))
    return values
