"""Zero-shot digital twins from one camera: the library (no Hydra, no globals)."""

__version__ = "0.1.0"
