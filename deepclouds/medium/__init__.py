"""Extinction, phase functions and transport through them, in Dr.Jit; each algorithm stands here once."""
