"""The second family of scenes: MuJoCo computes what happens and draws it."""

import ctypes.util
import importlib.util
import os

from ..errors import UsageError

# MuJoCo reads this when it is imported. OSMesa draws without a graphics card, the same everywhere.
os.environ["MUJOCO_GL"] = "osmesa"


def require_libraries() -> None:
    """Raise UsageError if something that this family needs is not installed."""
    for module in ("mujoco", "OpenGL", "skimage"):
        if importlib.util.find_spec(module) is None:
            raise UsageError(f"the family `other` needs the module {module}; run `pip install 'cow-scenes[other]'`")
    if ctypes.util.find_library("OSMesa") is None:
        raise UsageError("the family `other` draws with OSMesa; install Debian's package libosmesa6")
