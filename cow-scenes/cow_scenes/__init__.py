"""Makes benchmark items with known truth: Bullet computes what happens, Blender's Cycles draws it."""

__version__ = "0.1.0"
