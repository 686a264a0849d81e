"""Settings of the MuJoCo library that hold for the whole process, and who needs them changed.

While a backend exists the profiling callback is off (it costs a third of a step of a small model)
and MuJoCo writes no log, nor calls a handler of warnings (dm_control installs one that logs each of
them, of every point of a filter). Warnings are still counted in `mjData.warning`, and estbench
reports the runs that they end. The settings are restored when the last user is gone.
"""

import ctypes
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco

_CALLBACKS = ("mjcb_time", "mju_user_warning")

_users = 0
_saved: tuple[list[int | None], mujoco.MjLogConfig] | None = None
# Reentrant: garbage collection may end one user while another one begins in the same thread.
_lock = threading.RLock()


def hold(owner: object) -> weakref.finalize:
    """Change the settings until the result is called or the owner is garbage-collected."""
    _enter()
    return weakref.finalize(owner, _leave)


@contextmanager
def engine() -> Iterator[None]:
    """Change the settings inside a `with` block."""
    _enter()
    try:
        yield
    finally:
        _leave()


def _enter() -> None:
    global _users, _saved
    with _lock:
        _users += 1
        if _users == 1:
            callbacks = [_callback(name) for name in _CALLBACKS]
            _saved = [callback.value for callback in callbacks], mujoco.MjLogConfig.get()
            for callback in callbacks:
                callback.value = None
            silent = mujoco.MjLogConfig.get()
            silent.logto_console, silent.logto_file = 0, 0
            mujoco.MjLogConfig.set(silent)


def _leave() -> None:
    global _users, _saved
    with _lock:
        _users -= 1
        if _users == 0 and _saved is not None:
            for name, value in zip(_CALLBACKS, _saved[0]):
                _callback(name).value = value
            mujoco.MjLogConfig.set(_saved[1])
            _saved = None


def computes_user_sensors() -> bool:
    """Whether a callback is installed that computes sensors of type `user`."""
    return _callback("mjcb_sensor").value is not None


def _callback(name: str) -> ctypes.c_void_p:
    """A global callback pointer of the loaded library, by its name."""
    library = next(Path(str(mujoco.__file__)).parent.glob("libmujoco.*"))
    return ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), name)
