"""Arrays by what they hold. Their shapes stand where they are used."""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # RGB [H, W, 3]
Mask = NDArray[np.bool_]  # [H, W]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
