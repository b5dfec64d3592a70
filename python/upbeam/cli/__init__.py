"""The command line: it may import everything, and hands backends and frame sources down as arguments."""
