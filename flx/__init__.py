"""flx: learn the texture of one mesh and make new ones."""

__version__ = "0.1.0"
