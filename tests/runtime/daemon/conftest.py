"""Tests here share ``daemon_feed``, which importlib's import mode would not find."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
