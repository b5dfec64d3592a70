"""Packets of Velodyne sensors: decoding, encoding, captures."""
