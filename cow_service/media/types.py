"""Arrays by what they hold. They need no OpenCV, which machines with a GPU and nothing else may lack."""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # RGB [H, W, 3]
Mask = NDArray[np.bool_]  # [H, W]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
