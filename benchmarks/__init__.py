"""Benchmarks: run time against error, side by side in one run. Nothing here decides whether a test passes."""
