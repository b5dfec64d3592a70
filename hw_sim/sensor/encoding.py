"""Firings to payloads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from functools import lru_cache
from upbeam.model.beams import beam_table as _bt

beam_table = lru_cache(_bt)

from .datagram import PACKET
from .sources import Returns

__all__ = ["RETURN_MODES", "encode_firings", "encode_position"]

RETURN_MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
_MODELS = {"hdl-32e": 0x21, "vlp-16": 0x22, "vlp-32c": 0x28}


def encode_firings(
    model: str, returns: str, azimuth_mdeg: NDArray[np.int64], distance: NDArray[np.uint16],
    intensity: NDArray[np.uint8], last: Returns | None, toh_us: int,
) -> bytes:  # fmt: skip
    packet = np.zeros((), dtype=PACKET)
    b = packet["blocks"]
    b["flag"] = 0xEEFF
    slot = beam_table(model).laser_id.astype(int)
    if model == "vlp-16":
        cells = np.concatenate([slot, slot + 16])
        distance, intensity = distance.reshape(-1, 32), intensity.reshape(-1, 32)
        azimuth_mdeg = azimuth_mdeg[::2]
        if last is not None:
            last = Returns(last.distance.reshape(-1, 32), last.intensity.reshape(-1, 32))
        slot = cells
    planes = [(distance, intensity)] if last is None else [(last.distance, last.intensity), (distance, intensity)]
    for k, (d, i) in enumerate(planes):
        part = b[k :: len(planes)]
        part["azimuth"] = azimuth_mdeg // 10
        part["returns"]["distance"][:, slot] = d
        part["returns"]["intensity"][:, slot] = i
    packet["tail"] = (toh_us, RETURN_MODES[returns], _MODELS[model])
    return packet.tobytes()


def encode_position(toh_us: int) -> bytes:
    payload = bytearray(512)
    payload[198:202] = toh_us.to_bytes(4, "little")
    payload[202] = 2
    return bytes(payload)


def change_position(payload, change):
    out = bytearray(payload)
    now = {"time_us": int.from_bytes(payload[198:202], "little"), "pps": payload[202]}
    new = change(now)
    if "time_us" in new:
        out[198:202] = new["time_us"].to_bytes(4, "little")
    if "pps" in new:
        out[202] = new["pps"]
    return bytes(out)
