"""Fuzzing of every door through which data of others enters."""
