"""Power sensors of real hardware: INA3221 rails, ``tegrastats`` (live and logs), RAPL; and the rules of measuring.

A rail that is the total is never added to its parts. Power is measured over at least ten seconds, and a measured idle
is subtracted. Where there is no sensor there is no number.
"""

from .rails import MeasureError, Recording, total_power
from .sensors import Sensor, find_sensors, record

__all__ = ["MeasureError", "Recording", "Sensor", "find_sensors", "record", "total_power"]
