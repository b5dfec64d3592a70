"""The checksums of the bus side, named by their entries in the catalogue of parametrised CRC algorithms."""

from __future__ import annotations

CRC8_POLYNOMIAL = 0x1D
CRC16_POLYNOMIAL = 0x1021
CRC16_START = 0xFFFF


def crc8(data: bytes, crc: int = 0) -> int:
    """CRC-8/GSM-A (check value 0x37): SAE J1850's generator, start and final XOR 0, as E2E Profile 11 uses it."""
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1) ^ CRC8_POLYNOMIAL if crc & 0x80 else crc << 1
        crc &= 0xFF
    return crc


def crc16(data: bytes, crc: int = CRC16_START) -> int:
    """CRC-16/IBM-3740, also called CCITT-FALSE (check value 0x29B1): E2E Profile 5 and the serial console."""
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ CRC16_POLYNOMIAL if crc & 0x8000 else crc << 1
        crc &= 0xFFFF
    return crc
