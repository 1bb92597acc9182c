"""Contract checks of tip-tilt modulators."""

from __future__ import annotations

import math
from dataclasses import replace

from escape_hw.api.modulator import Modulation, ModulatorInfo, ModulatorStatus, TipTiltModulator
from escape_hw.errors import SettingRejected
from escape_hw.testing.checks import READS, TINY, assert_identified, assert_refused, check, replace_hook

#: Tilt within the range of any stage for a pyramid sensor, radians.
_SMALL_RAD = 1e-6


def _trial_modulation(modulator: TipTiltModulator) -> Modulation:
    """A small circle at a possible frequency that is probably not exactly achievable."""
    for rate in (97.3, 9.73, 0.973, 973.0):
        want = Modulation(_SMALL_RAD, rate)
        try:
            modulator.check(want)
        except SettingRejected:
            continue
        return want
    raise AssertionError(f"{modulator.name}: rejects {_SMALL_RAD} rad at every frequency from 1 Hz to 1 kHz")


@check(TipTiltModulator, READS)
def check_modulator_info(modulator: TipTiltModulator) -> None:
    """``info`` is complete, and ``check`` rejects tilts beyond ``info.max_tilt_rad``."""
    info = modulator.info
    assert_identified(info, ModulatorInfo)
    limit = info.max_tilt_rad
    assert 0 < limit < math.inf, f"info.max_tilt_rad is {limit}; it must be positive and finite"
    wide = replace(_trial_modulation(modulator), radius_rad=1.01 * limit)
    assert_refused(modulator, SettingRejected, "a radius beyond info.max_tilt_rad", modulator.check, wide)


@check(TipTiltModulator, READS)
def check_modulator_check_changes_nothing(modulator: TipTiltModulator) -> None:
    """``check`` moves nothing, and a second ``check`` returns its result unchanged."""
    before, want = modulator.modulation, _trial_modulation(modulator)
    answer = modulator.check(want)
    assert isinstance(answer, Modulation), f"check() returned {type(answer).__name__}"
    again = modulator.check(answer)
    assert again == answer, f"check() made {answer} of {want}, and then {again} of its own answer"
    after = modulator.modulation
    assert after == before, f"check() changed the modulation from {before} to {after}"


@check(TipTiltModulator, READS)
def check_modulator_refuses_meaningless(modulator: TipTiltModulator) -> None:
    """Invalid radius, frequency and centre are rejected and move nothing."""
    before, good = modulator.modulation, _trial_modulation(modulator)
    wrong = [replace(good, radius_rad=r) for r in (-1e-6, math.nan, math.inf)]
    wrong += [replace(good, frequency_hz=f) for f in (0.0, -1.0, math.nan, math.inf)]
    wrong += [replace(good, centre_rad=c) for c in ((math.nan, 0.0), (0.0, math.inf))]
    for want in wrong:
        for verb in (modulator.check, modulator.modulate):
            assert_refused(modulator, SettingRejected, f"{verb.__name__}({want})", verb, want)
        assert modulator.modulation == before, f"{want} was rejected, but the modulation changed"


@check(TipTiltModulator, TINY)
def check_modulator_reports_actual_modulation(modulator: TipTiltModulator) -> None:
    """The result of ``modulate`` agrees with ``modulation`` and with ``check``."""
    want = _trial_modulation(modulator)
    checked = modulator.check(want)
    answer, now = modulator.modulate(want), modulator.modulation
    assert answer == now, f"modulate() returned {answer}, but modulation is {now}"
    off = abs(answer.frequency_hz / checked.frequency_hz - 1)
    assert off < 0.01, f"check() returned {checked.frequency_hz} Hz, modulate() {answer.frequency_hz} Hz"
    still = modulator.modulate(replace(want, radius_rad=0.0))
    assert still.radius_rad == 0.0, f"radius 0 requested, got {still.radius_rad} rad"


@check(TipTiltModulator, TINY)
def check_modulator_parks(modulator: TipTiltModulator) -> None:
    """``park`` stops the modulation and may be repeated; the stage is parked on opening."""
    assert modulator.modulation is None, f"modulating on opening: {modulator.modulation}"
    modulator.park()
    modulator.modulate(_trial_modulation(modulator))
    for _ in range(2):
        modulator.park()
        assert modulator.modulation is None, f"after park(): {modulator.modulation}"


@check(TipTiltModulator, TINY)
def check_modulator_is_parked_when_closed(modulator: TipTiltModulator) -> None:
    """``close`` parks before disconnection."""
    modulator.modulate(_trial_modulation(modulator))
    disconnect, state_at_close = modulator._close, []

    def record_and_close() -> None:
        state_at_close.append(modulator.modulation)
        disconnect()

    with replace_hook(modulator, "_close", record_and_close):
        modulator.close()
    assert state_at_close == [None], f"the modulation at disconnection was {state_at_close}"


@check(TipTiltModulator, TINY)
def check_modulator_status_moves_nothing(modulator: TipTiltModulator) -> None:
    """``status`` is correct while modulating, parked and closed, and changes nothing."""
    for turning in (False, True):
        if turning:
            modulator.modulate(_trial_modulation(modulator))
        now = modulator.modulation
        status = modulator.status()
        assert isinstance(status, ModulatorStatus), f"status() returned {type(status).__name__}"
        assert status.info == modulator.info, f"status() has {status.info}, not {modulator.info}"
        assert status.modulation == now, f"status() has {status.modulation}, modulation is {now}"
        assert modulator.modulation == now, f"status() changed {now} to {modulator.modulation}"
    modulator.close()
    rest = modulator.status().modulation
    assert rest is None, f"status() of the closed stage has {rest}, but closing parks"
    assert not modulator.is_open, "status() opened a closed stage"
