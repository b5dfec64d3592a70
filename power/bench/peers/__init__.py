"""Other runtimes on the same work, each in a process of its own, so that threads, settings and crashes stay apart."""

from .pool import PEERS, PeerPool, missing_peers

__all__ = ["PEERS", "PeerPool", "missing_peers"]
