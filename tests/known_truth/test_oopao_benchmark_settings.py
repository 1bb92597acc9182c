"""OOPAO is imported late, prints nothing, and cannot end the process."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from escape_sim.oopao.library import make_source, oopao_classes, suppress_output


def _run(code: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    env.pop("DISPLAY", None)
    env.pop("MPLBACKEND", None)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=120)


def test_importing_the_twin_does_not_import_oopao():
    names = "models.factory", "models.shack_hartmann", "oopao.models", "oopao.optics", "devices.twins"
    modules = ", ".join(f"escape_sim.{name}" for name in names)
    done = _run(f"import sys, {modules}; print('OOPAO' in sys.modules, 'matplotlib' in sys.modules)")
    assert done.stdout.split() == ["False", "False"], done.stderr


@pytest.mark.slow
def test_nothing_is_printed_and_nothing_drawn():
    done = _run(
        "import tomllib\n"
        "from importlib.resources import files\n"
        "from escape_hw.api.registration import Registration\n"
        "from escape_hw.config.system import SystemConfig\n"
        "from escape_sim.oopao.models import make_oopao_model\n"
        "text = (files('escape_hw.config') / 'systems' / 'razor-shwfs.toml').read_text()\n"
        "model = make_oopao_model(SystemConfig.model_validate(tomllib.loads(text)), None)\n"
        "model.zonal_matrix(Registration(5, 5, 1, 1, 1))\n"
        "import matplotlib as mpl, sys\n"
        "sys.stderr.write('%s %s' % (mpl.pyplot.get_fignums(), mpl.rcParams._get_backend_or_none()))\n"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    # No figure, and no backend chosen on the user's behalf.
    assert done.stderr == "[] None"


def test_a_command_of_the_wrong_length_does_not_end_the_process():
    light = make_source(np.ones((16, 16), np.float32), 1.0, 635e-9)
    with suppress_output():
        mirror = oopao_classes().DeformableMirror(
            telescope=light.telescope,
            nSubap=2,
            coordinates=np.zeros((3, 2)),
            pitch=0.5,
            print_dm_properties=False,
        )

    def send():
        with suppress_output():
            mirror.coefs = np.zeros(7)

    with pytest.raises(RuntimeError, match="end the process"):
        send()
    # The stream is restored.
    assert type(sys.stdout).__name__ != "_ThreadFilteredOutput"


def test_only_the_thread_that_uses_oopao_is_silenced(capsys):
    def elsewhere():
        print("from elsewhere")

    with suppress_output():
        print("from OOPAO")
        other = threading.Thread(target=elsewhere)
        other.start()
        other.join()
    print("afterwards")
    assert capsys.readouterr().out == "from elsewhere\nafterwards\n"


def test_the_random_state_of_the_user_is_left_alone():
    np.random.seed(5)
    want = np.random.random()
    np.random.seed(5)
    make_source(np.ones((16, 16), np.float32), 1.0, 635e-9)
    assert np.random.random() == want
