"""Design of a sweep: matrix variants, search space, stages, and the slot of each loop."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from escape_hw.runtime.sweep.search_space import Parameter

#: The stages in their order: drawn parameters; the best few of each variant on common realisations of the
#: turbulence; the best of each variant on fresh common realisations.
EXPLORE, SHORTLIST, FINAL = "explore", "shortlist", "final"
STAGES = (EXPLORE, SHORTLIST, FINAL)
#: The Strehl ratios that can be maximised.
METRICS = ("peak", "otf", "encircled")
#: Spacing of the stages' seeds.
_SEED_SPACING = 1_000_000
#: Names of version 0.1.0 in stored studies and sweep.json, and today's.
_RENAMED_KEYS = {
    "arm": "variant", "arms": "variants", "heats": "replicates", "finals": "final_replicates"
}  # fmt: skip


def current_keys(stored: Any) -> Any:
    """A stored JSON value with the keys of version 0.1.0 replaced by today's."""
    if isinstance(stored, dict):
        return {_RENAMED_KEYS.get(key, key): current_keys(value) for key, value in stored.items()}
    return [current_keys(value) for value in stored] if isinstance(stored, list) else stored


@dataclass(frozen=True, slots=True)
class MatrixVariant:
    """One of the matrices to compare: its name, whether optical gains scale it, its file and checksum."""

    matrix: str
    optical_gains: bool
    path: Path
    sha256: str

    @property
    def label(self) -> str:
        """Name of the variant in tables and stored trials."""
        return f"{self.matrix} + OG" if self.optical_gains else self.matrix


@dataclass(frozen=True, slots=True)
class Slot:
    """Place of one loop in the design: stage, label of the matrix variant, and numbers.

    ``index`` is the turbulence realisation, common to all variants and candidates; ``candidate`` the
    parameter set, in the later stages.
    """

    stage: str
    variant: str
    index: int
    candidate: int = 0

    def run_seed(self, seed: int) -> int:
        """Seed of turbulence and noise; no two stages share one."""
        return seed + _SEED_SPACING * (1 + STAGES.index(self.stage)) + self.index


@dataclass(frozen=True, slots=True)
class Design:
    """Number of loops in each stage.

    ``trials`` loops of the first stage, over all variants; ``candidates`` parameter sets of each variant in
    the second stage, each on ``replicates`` realisations; ``final_replicates`` realisations for the best one.
    """

    trials: int = 200
    candidates: int = 3
    replicates: int = 4
    final_replicates: int = 20

    def exploration_slots(self, variants: Sequence[MatrixVariant]) -> Iterator[Slot]:
        """Slots of the first stage: one realisation after the other, each with every variant."""
        for number in range(self.trials):
            yield Slot(EXPLORE, variants[number % len(variants)].label, number // len(variants))

    def shortlist_slots(self, variants: Sequence[MatrixVariant]) -> Iterator[Slot]:
        """Slots of the second stage."""
        for index in range(self.replicates):
            for variant in variants:
                for candidate in range(self.candidates):
                    yield Slot(SHORTLIST, variant.label, index, candidate)

    def final_slots(self, variants: Sequence[MatrixVariant]) -> Iterator[Slot]:
        """Slots of the last stage."""
        for index in range(self.final_replicates):
            for variant in variants:
                yield Slot(FINAL, variant.label, index)

    def n_loops(self, n_variants: int) -> int:
        """Loops of all stages."""
        return self.trials + n_variants * (self.candidates * self.replicates + self.final_replicates)


@dataclass(frozen=True, slots=True)
class Sweep:
    """What is swept.

    ``config`` is the whole configuration as TOML, ``frames`` the length of a loop, ``seed`` that of the draws
    and of the turbulence, ``metric`` the Strehl ratio that is maximised, ``psf`` the file of the model PSF
    (``None``: each trial computes its own). If ``simulated``, each trial opens a simulated bench with its own
    turbulence.
    """

    config: str
    variants: tuple[MatrixVariant, ...]
    space: tuple[Parameter, ...]
    design: Design
    frames: int
    seed: int
    metric: str = "peak"
    psf: str | None = None
    simulated: bool = True

    def merit(self, outcome: Mapping[str, Any]) -> float | None:
        """The Strehl ratio that is maximised; ``None`` for a loop that diverged."""
        if outcome["diverged"] or outcome["strehl"] is None:
            return None
        return float(outcome["strehl"][self.metric]["value"])


def draw_parameters(space: Sequence[Parameter], seed: int, index: int) -> dict[str, Any]:
    """Random parameters of a realisation.

    They depend on the seed, the number of the realisation and the key only. All variants therefore run the
    same parameters on the same turbulence, in whatever order and on whatever machine.
    """
    return {
        one.key: one.at(float(np.random.default_rng((seed, index, zlib.crc32(one.key.encode()))).random()))
        for one in space
    }
