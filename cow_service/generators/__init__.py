"""Who makes frames: one file or folder per generator, all behind the Protocol in `base.py`."""
