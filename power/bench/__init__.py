"""``upbeam bench``: what this machine can do, what our kernels make of it, and others on the same work in the same run.

Compiled parts are in ``c/``; ``plain_windows.c`` is compiled when the benchmark runs, as a comparator.
"""
