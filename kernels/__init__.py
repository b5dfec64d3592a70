"""The window kernel. The C sources under ``cpu/`` are compiled into the runtime."""
