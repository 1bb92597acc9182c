"""Section [sensor], one model for each kind of wavefront sensor."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from escape_hw.config import layouts
from escape_hw.config.section import LayoutText, RuleViolation, Section, TomlArray, raise_violations

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Kind of a section without ``kind``.
_DEFAULT_KIND = "shack-hartmann"

Coordinate = Annotated[float, Field(ge=0, le=16384)]
Point = TomlArray[tuple[Coordinate, Coordinate]]


class SensorSection(Section):
    """Keys of every kind of sensor."""

    kind: str = Field(_DEFAULT_KIND, description="kind of sensor")
    n_sub: int = Field(ge=2, le=400, description="sub-apertures across the pupil")
    min_flux: float = Field(
        0.5, gt=0, le=1, description="smallest flux of a valid sub-aperture, fraction of the brightest"
    )
    beam_radius_m: Annotated[float, Field(allow_inf_nan=True)] = Field(
        math.inf, gt=0, description="1/e^2 intensity radius of the Gaussian beam, metres; inf: uniform"
    )


class ShackHartmannSection(SensorSection):
    """A Shack-Hartmann sensor."""

    kind: Literal["shack-hartmann"] = Field(
        "shack-hartmann", description="kind of sensor: 'shack-hartmann' or 'pyramid'"
    )
    pitch_px: float = Field(ge=2, le=1000, description="nominal pitch of the lenslets, camera pixels")
    spot_px: float = Field(ge=0.5, le=200, description="lambda/d of a sub-aperture, camera pixels")
    threshold: float = Field(
        0.02, ge=0, le=0.9, description="centre-of-gravity threshold above background, fraction of full scale"
    )
    motion_sigma: float = Field(
        0.25, gt=0, le=2,
        description="SPRINT: relative uncertainty of the spots' motion; choice, since blur within the "
        "lenslets counts as motion, too",
    )  # fmt: skip
    valid: LayoutText | None = Field(
        None,
        description="valid sub-apertures on the grid of n_sub x n_sub: 'circle-N', 'square-N', "
        "'rows:4,6,6,4' (sub-apertures per row) or 'mask:FILE' (text, .npy or .fits); absent: those lit "
        "above min_flux",
    )

    @model_validator(mode="after")
    def _valid_rules(self) -> Self:
        shape = (self.n_sub, self.n_sub)
        if self.valid is not None and layouts.map_shape(self.valid) != shape:
            has = layouts.map_shape(self.valid)
            has_text = "is not on a grid" if has is None else f"has {has[0]} rows of {has[1]}"
            text = f"{has_text}; n_sub = {self.n_sub} needs {self.n_sub} rows of {self.n_sub} columns"
            raise_violations([RuleViolation("valid", layouts.shorten(self.valid), text)])
        return self

    def valid_map(self) -> NDArray[np.bool_] | None:
        """Map ``(n_sub, n_sub)`` of the configured valid sub-apertures; ``None``: those that are lit."""
        return None if self.valid is None else layouts.layout_map(self.valid)

    def least_region(self) -> tuple[int, int]:
        """Width and height in pixels of the valid sub-apertures, or of those certainly within the pupil."""
        import numpy as np

        valid = self.valid_map()
        if valid is None:
            # Sub-apertures at the rim may be dark, and beyond the region.
            side = int((self.n_sub - 2) * self.pitch_px)
            return side, side
        used = (np.flatnonzero(valid.any(axis=axis)) for axis in (0, 1))
        width, height = (int((np.ptp(at) + 1) * self.pitch_px) for at in used)
        return width, height


class PyramidSection(SensorSection):
    """A four-sided pyramid sensor; a sub-aperture is one pixel of the pupil image."""

    kind: Literal["pyramid"] = Field(description="kind of sensor: 'shack-hartmann' or 'pyramid'")
    n_sub: int = Field(ge=4, le=400, description="diameter of a pupil image, camera pixels")
    pupils_px: TomlArray[tuple[Point, Point, Point, Point]] = Field(
        description="nominal centres of the pupil images in the region, (x, y) in pixels: "
        "upper left, upper right, lower left, lower right"
    )
    modulation: float = Field(3.0, ge=0, le=50, description="modulation radius, lambda/D; 0: none")
    normalisation: Literal["global", "local"] = Field(
        "global",
        description="slopes are divided by the mean flux of all pixels ('global') "
        "or by the flux of each pixel ('local')",
    )
    turbulence_sigma: float = Field(
        0.4, gt=0, le=2,
        description="SPRINT: relative uncertainty of the turbulence strength, found from the slopes' motion, "
        "which saturates: a twin of D/r0 = 22 was found as 14",
    )  # fmt: skip
    ellipticity_sigma: float = Field(
        0.05,
        gt=0,
        le=1,
        description="SPRINT: relative ellipticity of the modulation, rms along each direction; choice",
    )
    image_position_sigma_px: float = Field(
        0.1, gt=0, le=10,
        description="SPRINT: uncertainty of the pupil images' relative positions, pixels; found on twins of "
        "MAPS with a contaminated pupil",
    )  # fmt: skip
    gain_trend: float = Field(
        0.3, gt=0, le=2,
        description="SPRINT: relative change of the slopes' gain towards the rim: under turbulence and pokes "
        "the response there is known approximately; found on twins of RAZOR: 0.2 to 0.3",
    )  # fmt: skip

    @model_validator(mode="after")
    def _rules(self) -> Self:
        raise_violations(_placement_violations(self.pupils_px, self.n_sub))
        return self

    def pupils_outside(self, width: int, height: int) -> list[int]:
        """Numbers of the nominal pupil images that extend beyond the region."""
        half = self.n_sub / 2
        return [
            number
            for number, (x, y) in enumerate(self.pupils_px)
            if min(x, y) < half - 0.5 or x > width - half - 0.5 or y > height - half - 0.5
        ]


def _placement_violations(centres: tuple[tuple[float, float], ...], n_sub: int) -> list[RuleViolation]:
    """Violations by pupil images in the wrong order, or overlapping."""
    violations = []
    places = ("upper left", "upper right", "lower left", "lower right")
    for first, second, axis in ((0, 1, 0), (2, 3, 0), (0, 2, 1), (1, 3, 1)):
        if centres[first][axis] >= centres[second][axis]:
            side = "right of" if axis == 0 else "below"
            text = f"the {places[second]} image must lie {side} the {places[first]} one"
            violations.append(RuleViolation("pupils_px", [list(centre) for centre in centres], text))
    for first, second in combinations(range(4), 2):
        if not violations and math.dist(centres[first], centres[second]) < n_sub:
            text = f"the {places[first]} and {places[second]} images of {n_sub} pixels overlap"
            pair = [list(centres[first]), list(centres[second])]
            violations.append(RuleViolation("pupils_px", pair, text))
    return violations


def _kind(value: Any) -> Any:
    return (
        value.get("kind", _DEFAULT_KIND) if isinstance(value, dict) else getattr(value, "kind", _DEFAULT_KIND)
    )


#: A section of either kind, selected by the key ``kind``.
AnySensor = Annotated[
    Annotated[ShackHartmannSection, Tag("shack-hartmann")] | Annotated[PyramidSection, Tag("pyramid")],
    Discriminator(_kind),
]
