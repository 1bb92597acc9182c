"""A synthetic model is nominal: its matrix does not depend on the true state of the twin."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.registration import Registration
from escape_hw.config.loader import load_system
from escape_hw.config.registry import model_factory

#: A little of everything that a twin can hide.
HIDDEN = (
    "twin.registration.shift_x=43.0", "twin.registration.rotation=3.0",
    "twin.registration.radial_scaling=-5.0", "twin.registration.anamorphosis_angle=20.0",
    "twin.mirror.shape=gaussian", "twin.mirror.gain_scatter=0.2", "twin.mirror.coupling=0.3",
    "twin.mirror.width_scatter=0.1", "twin.mirror.wing_fraction=0.1", "twin.mirror.settling_s=2e-3",
    "twin.wfs.photons_per_frame=1e4", "twin.wfs.read_noise_e=50", "twin.wfs.fixed_pattern=0.1",
    "twin.vibration.amplitude_rad=[1e-4,1e-4]", "twin.ncpa.rms_m=2e-7", "twin.latency_s=2e-3",
    "twin.loss_probability=0.2", "twin.contamination.edge_share=0.2", "system.seed=99",
    "twin.mirror.stroke_m=2.4e-6", "twin.beam.radius_m=4e-3", "twin.beam.centre_m=[3e-4,-2e-4]",
)  # fmt: skip
LENSLETS = (
    "sensor.n_sub=12", "devices.wfs.region=[220,156,200,200]", 'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0", "basis.n_modes=20", "loop.dropped_modes=0",
)  # fmt: skip
PYRAMID = ('devices.dm.layout="circle-7"', "devices.dm.pitches_across_pupil=5.0", "basis.n_modes=20")
PYRAMID = (*PYRAMID, "loop.dropped_modes=0", "sensor.modulation=2.0")
SENSORS = {
    "lenslets": ("razor-shwfs", LENSLETS, (
        "twin.wfs.pitch_px=15.7", "twin.wfs.grid_offset_px=[5.0,-4.0]", "twin.wfs.clocking_deg=0.5",
        "twin.wfs.distortion=0.002",
    )),
    "pyramid": ("razor-pywfs", PYRAMID, (
        "twin.pyramid.rooftop=1.0", "twin.pyramid.ellipse=0.2", "twin.pyramid.ellipse_angle_deg=30.0",
        "twin.pyramid.radius_error=0.1", "twin.pyramid.diameter_px=64.6",
    )),
}  # fmt: skip
SOMEWHERE = Registration(-16.0, 31.0, -0.77, 2.9, 0.5)


@pytest.mark.parametrize("sensor", ["lenslets", pytest.param("pyramid", marks=pytest.mark.slow)])
@pytest.mark.parametrize("model", ["fast", pytest.param("oopao", marks=pytest.mark.slow)])
def test_no_model_reads_the_twin(sensor, model):
    system, design, hidden = SENSORS[sensor]
    if (sensor, model) == ("pyramid", "oopao"):
        # OOPAO's images stand on a square around the middle of its grid.
        design = (
            *design, "devices.wfs.region=[248,184,144,144]",
            "sensor.pupils_px=[[35.5,35.5],[107.5,35.5],[35.5,107.5],[107.5,107.5]]",
        )  # fmt: skip
    bare = load_system(system, overrides=design)
    full = load_system(system, overrides=(*design, *HIDDEN, *hidden))
    assert bare.twin != full.twin
    one, other = (model_factory(model)(config, None) for config in (bare, full))
    np.testing.assert_array_equal(one.zonal_matrix(SOMEWHERE), other.zonal_matrix(SOMEWHERE))
    for mine, its in zip(one.variants(), other.variants(), strict=True):
        np.testing.assert_array_equal(mine.zonal_matrix(SOMEWHERE), its.zonal_matrix(SOMEWHERE))
    np.testing.assert_array_equal(one.influence_functions()[0], other.influence_functions()[0])


def test_a_model_made_for_the_basis_computes_no_slopes(monkeypatch):
    def computed(*_):
        raise AssertionError("slopes were computed")

    monkeypatch.setattr("escape_sim.models.shack_hartmann.slope_weights", computed)
    model = model_factory("fast")(load_system("razor-shwfs", overrides=LENSLETS), None)
    assert len(model.influence_functions()[0]) == 37
    with pytest.raises(AssertionError, match="were computed"):
        model.zonal_matrix(SOMEWHERE)
