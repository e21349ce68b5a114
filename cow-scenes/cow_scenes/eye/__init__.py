"""The eye: pictures drawn for looking, and a small network trained on them that finds things in any picture."""

import ctypes.util
import importlib.util
import os

from ..errors import UsageError

# MuJoCo reads this when it is imported. OSMesa draws without a graphics card, the same everywhere.
os.environ["MUJOCO_GL"] = "osmesa"


def require_libraries() -> None:
    """Raise UsageError if something that the eye needs is not installed."""
    for module in ("cv2", "mujoco", "onnx", "OpenGL", "skimage", "torch"):
        if importlib.util.find_spec(module) is None:
            raise UsageError(f"the eye needs the module {module}; run `pip install 'cow-scenes[eye]'`")
    if ctypes.util.find_library("OSMesa") is None:
        raise UsageError("the eye's pictures are drawn with OSMesa; install Debian's package libosmesa6")
