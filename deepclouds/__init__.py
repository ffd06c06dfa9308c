"""Clouds, fog and smoke: what the trainer and the renderer must agree on."""
