"""A released model at work: prediction, and rendering with Mitsuba."""
