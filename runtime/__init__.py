"""The C runtime and what drives it: models, streams, the live runner."""
