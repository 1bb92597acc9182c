"""ESCAPE through the window's own buttons, on a real server with a twin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_system import configuration
from whole_run import Operator, operating

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.io.fits.matrix import load_matrix
from escape_hw.remote.state import Finish, FinishedRun


def injected(ended: FinishedRun) -> Registration:
    return Registration(**ended.document["injected"])


def recovered(ended: FinishedRun) -> None:
    """The registration is the injected one, within five of its standard errors."""
    truth = injected(ended).to_dict()
    for name in PARAMETERS:
        found = ended.document["registration"][name]
        assert abs(found["value"] - truth[name]) < 5 * found["sigma"], name


def calibrated(operator: Operator, ended: FinishedRun) -> None:
    """Check the content of the panels after ESCAPE."""
    window = operator.window
    modes, sprint = window.panels["modes"], window.panels["sprint"]
    assert ended.finish is Finish.DONE, ended.message
    recovered(ended)
    # The maps were updated during the acquisition.
    assert operator.seen["live_modes"]
    assert any(operator.seen["abort"])
    operator.until(lambda: {"DO-CRIME", "ESCAPE"} <= set(modes.matrices), "products are shown")
    assert sprint._indicator.text.startswith("converged")
    product = load_matrix(ended.products["im"])
    operator.until(lambda: modes.matrix_selector.currentText() == "ESCAPE", "the newest is in front")
    np.testing.assert_array_equal(modes.matrices["ESCAPE"].data, product.matrix.data)
    assert "Shift x" in operator.procedure.numbers.text()
    assert operator.procedure.report.isVisible()
    assert Path(ended.products["report"]).is_file()


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(configuration("calibration.checkpoint_s=1").to_toml())
    return path


@pytest.mark.slow
def test_escape_through_the_buttons(small: Path, tmp_path: Path) -> None:
    with operating(small, tmp_path) as operator:
        operator.take_control()
        calibrated(operator, operator.run("escape", frames="3000"))
        # Again, and aborted: the acquired data are saved.
        operator.choose("docrime", frames="1000000")
        operator.press(operator.procedure.start)
        source = operator.window.context.session.source
        operator.until(operator.procedure.abort.isEnabled, "it can be stopped")
        operator.until(lambda: bool(operator.procedure._metrics.text()), "it is under way")
        operator.press(operator.procedure.abort)
        operator.until(lambda: source.state.last_run.finish is Finish.ABORTED, "it is stopped")
        operator.until(lambda: "Aborted" in operator.procedure.outcome.text(), "the outcome is shown")


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_escape_on_the_shack_hartmann_bench(tmp_path: Path) -> None:
    with operating("razor-shwfs", tmp_path) as operator:
        operator.take_control()
        calibrated(operator, operator.run("escape", frames="4000"))


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_escape_and_gains_on_the_pyramid_bench(tmp_path: Path) -> None:
    with operating("razor-pywfs", tmp_path) as operator:
        operator.take_control()
        calibrated(operator, operator.run("escape", frames="3000"))
        ended = operator.run("gains", frames="600", accuracy="0.2", strehl="False")
        assert ended.finish is Finish.DONE, ended.message
        gains = operator.window.panels["gains"]
        operator.until(lambda: "ESCAPE" in gains._curves, "the gains are shown")
        np.testing.assert_allclose(gains._curves["ESCAPE"].trend, ended.document["trend"]["value"])
