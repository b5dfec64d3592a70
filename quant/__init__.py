"""The model file. Calibration, integer schemes and exporters join it here."""

from .ubm import ModelFile, UbmError, read_ubm, write_ubm

__all__ = ["ModelFile", "UbmError", "read_ubm", "write_ubm"]
