"""Each case has its own process: the settings are global, and backends of other tests may live."""

import subprocess
import sys

import pytest

PREAMBLE = """
import contextlib, ctypes, gc
from pathlib import Path
import mujoco, numpy as np
from estbench.robots import backend, library, mjcf

file = next(Path(mujoco.__file__).parent.glob("libmujoco.*"))
dll = ctypes.CDLL(str(file))
said = []
handler = ctypes.CFUNCTYPE(None, ctypes.c_char_p)(said.append)
ctypes.c_void_p.in_dll(dll, "mju_user_warning").value = ctypes.cast(handler, ctypes.c_void_p).value

def callback(name):
    return ctypes.c_void_p.in_dll(dll, name).value

def settings():
    log = mujoco.MjLogConfig.get()
    return callback("mjcb_time"), callback("mju_user_warning"), log.logto_console, log.logto_file

before = settings()
assert None not in before[:2]
changed = (None, None, 0, 0)
model = mjcf.compile_model(mujoco.MjSpec.from_string(
    '<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>'
))
"""

CASES = {
    "closed": """
one, two = backend.create(model), backend.create(model)
assert settings() == changed
one.close()
one.close()
assert settings() == changed
two.close()
assert settings() == before
""",
    "collected": """
one = backend.create(model)
assert settings() == changed
del one
gc.collect()
assert settings() == before
""",
    "a simulation that blows up": """
one = backend.create(model)
x = np.full((1, one.nx), 1e30)
assert np.isnan(one.step(x, np.zeros((1, model.nu)), 0.0, 1)).all()
assert not said
one.close()
assert settings() == before
""",
    "nested": """
with contextlib.suppress(KeyError), library.engine():
    assert settings() == changed
    with library.engine():
        pass
    assert settings() == changed
    raise KeyError
assert settings() == before
""",
}


@pytest.mark.parametrize("case", CASES)
def test_the_settings_are_put_back(case, tmp_path):
    (tmp_path / "case.py").write_text(PREAMBLE + CASES[case])
    done = subprocess.run(
        [sys.executable, "case.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.glob("MUJOCO_LOG*"))
