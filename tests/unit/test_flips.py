"""Orientation of cameras, numbering and polarity of mirrors: what devices get and deliver, and their keys."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_system import configuration

from escape_hw.api.adaptive_secondary import ShellHealth, ShellState
from escape_hw.api.camera import CameraSettings, Frame, Region
from escape_hw.api.flips import FLIPS, Flip, combine_flips, flip_image, flip_matrix, flip_order, inverse_flip
from escape_hw.config import layouts
from escape_hw.config.loader import load_text
from escape_hw.errors import ConfigError, SettingRejected
from escape_hw.safety.limits import MirrorLimits
from escape_hw.testing.reference_devices import IdealSecondary, RecordingMirror, SyntheticCamera

IMAGE = np.arange(12).reshape(3, 4)
#: Of the reference mirrors: a circle of five actuators across.
POSITIONS = layouts.positions("rows:3,5,5,5,3")


@pytest.mark.parametrize("first", FLIPS)
@pytest.mark.parametrize("second", FLIPS)
def test_flips_combine_as_their_images_do(first: Flip, second: Flip) -> None:
    twice = flip_image(flip_image(IMAGE, first), second)
    assert np.array_equal(twice, flip_image(IMAGE, combine_flips(first, second)))
    assert combine_flips(first, inverse_flip(first)) == "none"


@pytest.mark.parametrize("flip", FLIPS)
def test_points_move_as_their_pixels_do(flip: Flip) -> None:
    image = np.zeros((5, 5))
    image[1, 4] = 1.0  # x = 2, y = -1 from the centre
    row, column = np.argwhere(flip_image(image, flip))[0]
    assert [column - 2, row - 2] == (flip_matrix(flip) @ [2, -1]).tolist()


@pytest.mark.parametrize("flip", FLIPS)
def test_a_flipped_map_of_numbers_becomes_that_of_the_layout(flip: Flip) -> None:
    layout = layouts.layout_map("circle-7")
    numbers = np.full(layout.shape, -1)
    numbers[layout] = np.arange(layout.sum())
    order = flip_order(layouts.positions("circle-7"), flip)
    # The mirror's number k, on its own map, lies in the layout where the flip takes it.
    turned = flip_image(numbers, flip)
    assert np.array_equal(order[turned[layout]], numbers[layout])


def test_a_layout_that_a_flip_changes_is_refused() -> None:
    assert np.array_equal(np.sort(flip_order(layouts.positions("maps-336"), "left-right")), np.arange(336))
    with pytest.raises(ValueError, match="does not map onto itself by 'turn-90'"):
        flip_order(layouts.positions("maps-336"), "turn-90")


# --------------------------------------------------------------------- cameras
def frames(flip: Flip, settings: CameraSettings) -> tuple[list[Frame], list[Frame]]:
    """Frames as delivered, waited for and polled, and as the callback got them."""
    seen: list[Frame] = []
    with SyntheticCamera() as camera:
        camera.flip, camera.callback = flip, seen.append
        camera.configure(settings)
        polled = None
        delivered = [camera.next_frame()]
        while polled is None:
            polled = camera.poll()
        return [*delivered, polled], seen


SQUARE = CameraSettings(Region(8, 4, 16, 16), 1e-3, 500.0)


@pytest.mark.parametrize("flip", FLIPS)
def test_every_frame_is_turned(flip: Flip) -> None:
    raw, _ = frames("none", SQUARE)
    turned, seen = frames(flip, SQUARE)
    assert seen == turned
    for before, after in zip(raw, turned, strict=True):
        assert np.array_equal(after.data, flip_image(before.data, flip))
        assert after.data.flags.c_contiguous
        assert not after.data.flags.writeable
        assert (after.index, after.exposed_ns, after.n_saturated) == (
            before.index, before.exposed_ns, before.n_saturated,
        )  # fmt: skip


def test_exchanged_axes_need_a_square_region() -> None:
    with SyntheticCamera() as camera:
        camera.flip = "turn-90"
        with pytest.raises(SettingRejected, match="must be square, since flip = 'turn-90'"):
            camera.configure(CameraSettings(Region(0, 0, 32, 16), 1e-3, 500.0))
        assert camera.configure(SQUARE).region == SQUARE.region


# --------------------------------------------------------------------- mirrors
def rewire(mirror: Any, order: NDArray[np.intp] | None = None) -> Any:
    mirror.order, mirror.polarity = flip_order(POSITIONS, "turn-90") if order is None else order, -1
    return mirror


SHAPE = np.linspace(-0.4, 0.4, 21)


def test_the_hardware_gets_its_numbering_and_sign() -> None:
    mirror = rewire(RecordingMirror())
    with mirror:
        sent = mirror.send(SHAPE).sent
        assert np.array_equal(sent, SHAPE)
        assert np.array_equal(mirror.shape, SHAPE)
        assert np.array_equal(mirror.history[-1], -SHAPE[mirror.order])
    assert not mirror.history[-1].any()


def test_limits_of_neighbours_hold_in_the_layout() -> None:
    """A ramp is smooth on the layout, not in the order of a scrambled hardware."""
    limits = MirrorLimits(max_neighbour=0.06)
    ramp = 0.05 * POSITIONS[:, 0]
    scrambled = np.random.default_rng(0).permutation(21)
    with rewire(RecordingMirror("dm", limits), scrambled) as mirror:
        assert mirror.send(ramp).guard.clipped == 0
        assert np.array_equal(mirror.history[-1], -ramp[scrambled])
        rough = np.zeros(21)
        rough[10] = 0.2
        mirror.send(rough)
        assert np.abs(mirror.shape[10] - mirror.shape[[9, 11]]).max() <= 0.06 + 1e-9
    disabled = MirrorLimits(disabled=(4,))
    with rewire(RecordingMirror("dm", disabled), scrambled) as mirror:
        mirror.send(np.full(21, 0.1))
        assert np.flatnonzero(mirror.history[-1] == 0).tolist() == np.flatnonzero(scrambled == 4).tolist()


class Reporting(IdealSecondary):
    """A secondary that skips commands, reports a shape on opening, and has a contaminated actuator."""

    found = np.linspace(0.1, 0.2, 21)

    def _send_to_shell(self, command: NDArray[np.float64]) -> NDArray[np.float64]:  # type: ignore[override]
        return self.found

    def _present_shape(self) -> NDArray[np.float64]:
        return self.found

    def _measure_positions(self) -> NDArray[np.float64]:
        return np.where(np.arange(21) == 3, np.nan, self.found)

    def _health(self) -> ShellHealth:
        return ShellHealth(0, self._current_state, 50e-6, 0.1, 15.0, 0, contaminated=(3,))


def test_what_the_hardware_reports_is_in_the_numbering_of_the_layout() -> None:
    mirror = rewire(Reporting())
    mirror.lift = False
    mirror.open()
    in_layout = np.empty(21)
    in_layout[mirror.order] = -Reporting.found
    assert np.array_equal(mirror.shape, in_layout)
    place = int(mirror.order[3])
    assert mirror.health.contaminated == (place,)
    measured = mirror.measured_positions()
    assert np.flatnonzero(np.isnan(measured)).tolist() == [place]
    assert np.array_equal(np.delete(measured, place), np.delete(in_layout, place))
    mirror.go_to(ShellState.RUNNING)
    report = mirror.send(SHAPE)
    assert report.skipped
    assert np.array_equal(report.sent, in_layout)


def test_an_order_of_another_mirror_is_refused() -> None:
    mirror = rewire(RecordingMirror(), np.arange(20))
    with pytest.raises(SettingRejected, match="order has 20 numbers; it must have each of 0 to 20 once"):
        mirror.open()


# --------------------------------------------------------------------- keys
def test_a_table_of_numbers_is_stored_by_its_content(tmp_path: Path) -> None:
    numbers = np.random.default_rng(1).permutation(37)
    np.savetxt(tmp_path / "order.txt", numbers, fmt="%d")
    np.save(tmp_path / "order.npy", numbers)
    for name in ("order.txt", "order.npy"):
        config = configuration(f'devices.dm.order="table:{tmp_path / name}"')
        order = config.devices.dm.hardware_order()
        assert order is not None
        assert np.array_equal(order, numbers)
        assert load_text(config.to_toml()) == config


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("devices.dm.order=mirrored", "order 'mirrored' is unknown; choose 'none', 'left-right'"),
        ("devices.dm.order='numbers:1,a'", "order 'numbers:1,a' is unknown"),
        ("devices.dm.order='table:/none.txt'", "the table of numbers /none.txt: cannot be read"),
        ("devices.dm.order='numbers:0,1,1'", "has 3 numbers; it needs each of 0 to 36 once"),
        ("twin.mirror.order='numbers:0,1,1'", "has 3 numbers; it needs each of 0 to 36 once"),
        ("devices.wfs.flip=mirrored", "devices.wfs.flip: .* must be 'none', 'left-right'"),
        ("devices.dm.polarity=0", "devices.dm.polarity: 0 "),
    ],
)  # fmt: skip
def test_what_is_no_flip_or_order_is_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        configuration(override)


def test_a_region_that_is_not_square_cannot_be_turned() -> None:
    wide = "devices.science.region=[0,0,120,100]"
    assert configuration(wide, "devices.science.flip=turn-180").devices.science is not None
    for key in ("devices.science.flip", "twin.science.flip"):
        with pytest.raises(ConfigError, match=f"{key}: .*exchanges rows and columns; needs a square"):
            configuration(wide, f"{key}=transpose")
